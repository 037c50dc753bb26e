#!/bin/sh
# Finding: pycolmap reads an old images.bin beside an images.txt that was edited after it
# Software: pycolmap 4.2.1 (PyPI)
# Expected: of a folder with both forms the newer is read, or it is said that they differ
# Seen: the binary one is read, whatever the text says; nothing is said
# Meets: who edits poses in the text form (names, a scale, an axis) of a model that `write` left as binary beside it
# Here: binary is read first as well, as COLMAP does (docs/captures.md): remove the .bin files after editing.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6
venv/bin/python - <<'END'
import pathlib
import sys

import pycolmap

folder = pathlib.Path("model")
folder.mkdir()
(folder / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
(folder / "images.txt").write_text("1 1 0 0 0 7 0 0 1 a.png\n\n")
(folder / "points3D.txt").write_text("")
model = pycolmap.Reconstruction(folder)
model.write(folder)  # binary
model.write_text(folder)
text = folder / "images.txt"
text.write_text(text.read_text().replace(" 7 0 0 1 a.png", " 99 0 0 1 a.png"))
found = pycolmap.Reconstruction(folder).images[1].cam_from_world().translation
print("the text now says x = 99, read is x =", found[0])
sys.exit(0 if found[0] == 7 else "the behaviour has changed")
END
