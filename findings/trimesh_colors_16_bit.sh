#!/bin/sh
# Finding: trimesh keeps the low byte of colours of 16 bits
# Software: trimesh 5.2.0 (PyPI)
# Expected: 10000 of 65535 in a PLY file's `ushort` colours is read as 39 of 255
# Seen: it is read as 16, the value modulo 256: a smooth shade becomes stripes. glTF's COLOR_0 of 16 bits fares alike
# Meets: who puts a scanned object with 16-bit vertex colours beside a field
# Here: colours of PLY and glTF are read by readers of its own (`warpcage/render/surface_file.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6
venv/bin/python - <<'END'
import io
import sys

import trimesh

shades = [0, 10000, 30000, 65535]
head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
head += "".join(f"property ushort {name}\n" for name in ("red", "green", "blue"))
head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
rows = [f"{x} {y} 0 {shade} {shade} {shade}\n" for (x, y), shade in zip([(0, 0), (1, 0), (1, 1), (0, 1)], shades)]
text = head + "".join(rows) + "3 0 1 2\n3 0 2 3\n"
mesh = trimesh.load(io.BytesIO(text.encode()), file_type="ply", process=False)
found = mesh.visual.vertex_colors[:, 0].tolist()
print("of 65535:", shades, "should be, of 255:", [round(shade / 257) for shade in shades], "read as:", found)
sys.exit(0 if found == [shade % 256 for shade in shades] else "the behaviour has changed")
END
