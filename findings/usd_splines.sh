#!/bin/sh
# Finding: attributes that usd-core animates by splines have no time samples
# Software: usd-core 26.11 (PyPI)
# Expected: GetTimeSamples of an attribute whose value changes names times at which to look, or the prim says that it
#   moves otherwise
# Seen: it is empty for the attribute and for the Xformable, GetNumTimeSamples is 0, while the value at time 5 differs
#   from that at 0; ValueMightBeTimeVarying alone tells
# Meets: who converts films by walking over time samples: an object that moves by splines stands still
# Here: times come from the knots of splines as well (`warpcage/mesh/io/usd_stage.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check usd-core==26.11
venv/bin/python - <<'END'
import sys

from pxr import Ts, Usd, UsdGeom

stage = Usd.Stage.CreateInMemory()
form = UsdGeom.Xform.Define(stage, "/moved")
move = form.AddTranslateXOp()
spline = Ts.Spline("double")
for time, value in ((0, 0.0), (10, 5.0)):
    spline.SetKnot(Ts.Knot("double", time=time, value=value, nextInterp=Ts.InterpLinear))
attribute = move.GetAttr()
attribute.SetSpline(spline)
samples = [list(attribute.GetTimeSamples()), list(move.GetTimeSamples()), list(form.GetTimeSamples())]
places = [form.GetLocalTransformation(time)[3][0] for time in (0, 5, 10)]
print("time samples of the attribute, the operation and the prim:", *samples)
print("x at 0, 5 and 10:", places, "might vary:", attribute.ValueMightBeTimeVarying(), "spline:", attribute.HasSpline())
sys.exit(0 if samples == [[], [], []] and places == [0, 2.5, 5] else "the behaviour has changed")
END
