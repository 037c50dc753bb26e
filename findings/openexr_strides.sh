#!/bin/sh
# Finding: OpenEXR reads arrays as if they lay in a row, whatever their strides
# Software: OpenEXR 3.5.3 (PyPI)
# Expected: the transpose of a depth picture, or every second column of it, is written as NumPy shows it
# Seen: the numbers of the memory behind it are written in their order: a picture of the right size with other
#   content, without a word
# Meets: who writes a portrait picture turned by np.transpose, colours of a (3, h, w) tensor, or a part of a picture,
#   to EXR
# Here: pictures and depth are laid out in a row first (`warpcage/view/exr.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check OpenEXR==3.5.3 numpy==2.4.6
venv/bin/python - <<'END'
import sys

import numpy as np
import OpenEXR

depth = np.arange(24, dtype=np.float32).reshape(4, 6)
same = {}
for name, picture in {"whole": depth, "transpose": depth.T, "every second column": depth[:, ::2]}.items():
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"Z": picture}).write("depth.exr")
    with OpenEXR.File("depth.exr") as file:
        found = np.array(file.channels()["Z"].pixels)
    same[name] = found.shape == picture.shape and bool((found == picture).all())
    print(f"{name}: first row {picture[0].tolist()} is read back as {found[0].tolist()}")
sys.exit(0 if list(same.values()) == [True, False, False] else "the behaviour has changed")
END
