#!/bin/sh
# Finding: usd-core loses small turns of half quaternions, and makes those around three degrees too large
# Software: usd-core 26.11 (PyPI)
# Expected: xformOp:orient of precision half turns by 2 degrees within what a half float can hold: its imaginary part
#   is 0.01746, off by 0.0001
# Seen: no turn at all below 2.5 degrees, 3.58 for 2.6 and for 3: the angle is taken from the real part alone, which
#   rounds to 1 or 0.9995
# Meets: whose cage or camera is placed by a half quaternion (the type of instancers and of some exporters): slow
#   turns jump
# Here: turns are taken from all four numbers (`warpcage/mesh/io/usd.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check usd-core==26.11
venv/bin/python - <<'END'
import math
import sys

from pxr import Gf, Usd, UsdGeom

stage = Usd.Stage.CreateInMemory()
form = UsdGeom.Xform.Define(stage, "/turned")
turn = form.AddOrientOp(UsdGeom.XformOp.PrecisionHalf)
found = {}
for degrees in (1, 2, 2.4, 2.6, 3, 5, 30):
    half = math.radians(degrees) / 2
    turn.Set(Gf.Quath(math.cos(half), 0, 0, math.sin(half)))
    matrix, held = form.GetLocalTransformation(), turn.Get()
    found[degrees] = math.degrees(math.atan2(matrix[0][1], matrix[0][0]))
    by_all = math.degrees(2 * math.atan2(held.imaginary[2], held.real))
    print(f"{degrees} degrees: turned by {found[degrees]:.2f}, by all four numbers of the quaternion {by_all:.2f}")
sys.exit(0 if found[2.4] == 0 and 3.5 < found[2.6] < 3.7 and 29.9 < found[30] < 30.2 else "the behaviour has changed")
END
