#!/bin/sh
# Finding: images of a pycolmap reconstruction come in no order
# Software: pycolmap 4.2.1 (PyPI)
# Expected: `reconstruction.images` goes through images in the order of the file, of their numbers or of their names
# Seen: the order is that of a hash table: another one than all three, and than that of reg_image_ids()
# Meets: who zips a reconstruction's cameras with a sorted list of pictures: poses and pictures are mixed up
# Here: pictures are found by name, and views are sorted by it (`warpcage/scene/formats/colmap.py`).
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
names = {7: "h.png", 3: "g.png", 20: "f.png", 11: "e.png", 1: "d.png", 15: "c.png", 9: "b.png", 30: "a.png"}
rows = [f"{number} 1 0 0 0 {number} 0 0 1 {name}\n\n" for number, name in names.items()]
(folder / "images.txt").write_text("".join(rows))
(folder / "points3D.txt").write_text("")
model = pycolmap.Reconstruction(folder)
order = list(model.images)
print("in the file:", *names)
print("by name:", *sorted(names, key=names.get))
print("images:", *order, "reg_image_ids:", *model.reg_image_ids())
alike = order in (list(names), sorted(names), sorted(names, key=names.get), list(model.reg_image_ids()))
sys.exit("the behaviour has changed" if alike else 0)
END
