#!/bin/sh
# Finding: gsplat writes no splat at all where one has an infinite or missing opacity
# Software: gsplat 1.5.3 (PyPI; with torch 2.13.0, no GPU needed)
# Expected: of five splats, one with an infinite logit of opacity, export_splats leaves that one out, as it does for
#   places and scales
# Seen: the file has no splat: the test is made over all opacities together, and nothing is said
# Meets: who unpacks a compressed capture, whose opaque splats some programs make infinite, changes it in gsplat, and
#   saves it
# Here: infinite logits mean opacity 1 or 0 (docs/splats.md) and are written as finite ones, and rows that are no
#   splats are left out one by one, and counted (`warpcage/splats/io/contents.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gsplat==1.5.3 torch==2.13.0 numpy==2.4.6
venv/bin/python - <<'END'
import sys

import torch
from gsplat import export_splats


def written(name, value):
    """How many of five splats are written where a value of the third is another."""
    splats = {
        "means": torch.arange(15.0).reshape(5, 3), "scales": torch.full((5, 3), -3.0),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(5, 1), "opacities": torch.full((5,), 2.0),
        "sh0": torch.full((5, 1, 3), 0.5), "shN": torch.zeros(5, 0, 3),
    }
    splats[name][2] = value
    head = export_splats(**splats, format="ply").split(b"end_header")[0].decode()
    return next(int(line.split()[-1]) for line in head.splitlines() if line.startswith("element vertex"))


found = {}
for name in ("means", "scales", "quats", "opacities", "sh0"):
    found[name] = written(name, float("inf"))
    print(f"infinite {name} of one of five splats: {found[name]} are written")
expected = {"means": 4, "scales": 4, "quats": 4, "opacities": 0, "sh0": 4}
sys.exit(0 if found == expected else "the behaviour has changed")
END
