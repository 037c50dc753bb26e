#!/bin/sh
# Finding: a USD prim of Gaussian splats without an extent has empty bounds
# Software: usd-core 26.11 (PyPI)
# Expected: BBoxCache finds the bounds of ParticleField3DGaussianSplat from its positions where no extent is written,
#   as it does for Points and Mesh
# Seen: the range is empty: programs that frame the view by it show nothing, or put the camera at infinity
# Meets: who writes splats into a stage by hand, or gets them from a program that leaves the extent out
# Here: an extent is written with splats, and none is needed to read them (`warpcage/splats/io/usd.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check usd-core==26.11
venv/bin/python - <<'END'
import sys

from pxr import Gf, Usd, UsdGeom, UsdVol

stage = Usd.Stage.CreateInMemory()
places = [(0, 0, 0), (1, 2, 3)]
splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")
splats.CreatePositionsAttr(places)
splats.CreateScalesAttr([(0.1, 0.1, 0.1)] * 2)
splats.CreateOrientationsAttr([Gf.Quatf(1)] * 2)
splats.CreateOpacitiesAttr([1.0, 1.0])
points = UsdGeom.Points.Define(stage, "/points")
points.CreatePointsAttr(places)
points.CreateWidthsAttr([0.1, 0.1])
ranges = {}
for prim in (splats, points):
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    ranges[prim.GetPath().name] = cache.ComputeWorldBound(prim.GetPrim()).GetRange()
    print(prim.GetPrim().GetTypeName(), "empty:", ranges[prim.GetPath().name].IsEmpty())
sys.exit(0 if ranges["splats"].IsEmpty() and not ranges["points"].IsEmpty() else "the behaviour has changed")
END
