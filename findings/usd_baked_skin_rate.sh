#!/bin/sh
# Finding: usd-core bakes skins at the wrong times where a stage says its time codes a second and not 24
# Software: usd-core 26.11 (PyPI)
# Expected: 31 samples of shape weights at 30 time codes a second, as Blender writes them (timeCodesPerSecond alone),
#   are baked into 31 samples of points over the same second
# Seen: 49 samples, at times of framesPerSecond, whose fallback is 24; baked into the session layer, which keeps 24,
#   their times are stretched by 30/24 as well: at the last frame the shape has come 0.8 of the way
# Meets: who plays or converts an animated cage or object that Blender exported at 30 or 25 a second
# Here: skins and shapes are posed by readers of its own, at the stage's time codes (`warpcage/mesh/io/usd_stage.py`,
#   docs/blender.md).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check usd-core==26.11
venv/bin/python - <<'END'
import sys

from pxr import Gf, Usd, UsdGeom, UsdSkel


def baked(rate, session):
    """Times of the samples of points, and z at frame 30, of a shape that rises by 1 from frame 0 to 30."""
    stage = Usd.Stage.CreateInMemory()
    stage.SetMetadata("timeCodesPerSecond", rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(30)
    UsdSkel.Root.Define(stage, "/film")
    skeleton = UsdSkel.Skeleton.Define(stage, "/film/skeleton")
    skeleton.CreateJointsAttr(["joint"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    mesh = UsdGeom.Mesh.Define(stage, "/film/mesh")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets(["/film/skeleton"])
    binding.CreateJointIndicesPrimvar(True, 1).Set([0])
    binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    UsdSkel.BlendShape.Define(stage, "/film/mesh/up").CreateOffsetsAttr([(0, 0, 1)] * 3)
    binding.CreateBlendShapesAttr(["up"])
    binding.CreateBlendShapeTargetsRel().SetTargets(["/film/mesh/up"])
    animation = UsdSkel.Animation.Define(stage, "/film/skeleton/animation")
    animation.CreateJointsAttr(["joint"])
    animation.CreateTranslationsAttr([(0, 0, 0)])
    animation.CreateRotationsAttr([Gf.Quatf(1)])
    animation.CreateScalesAttr([Gf.Vec3h(1, 1, 1)])
    animation.CreateBlendShapesAttr(["up"])
    weights = animation.CreateBlendShapeWeightsAttr()
    for frame in range(31):
        weights.Set([frame / 30], frame)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(["/film/skeleton/animation"])
    if session:
        stage.SetEditTarget(stage.GetSessionLayer())
    UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPrimAtPath("/film")), Gf.Interval(0, 30))
    times = mesh.GetPointsAttr().GetTimeSamples()
    return len(times), times[-1], round(mesh.GetPointsAttr().Get(30)[0][2], 3)


found = {}
for rate in (24, 30):
    for session in (False, True):
        found[rate, session] = baked(rate, session)
        where = "session layer" if session else "same layer"
        print("%d a second, %s: %d samples, the last at %g, z at frame 30: %g" % (rate, where, *found[rate, session]))
right, wrong = (31, 30.0, 1.0), [(49, 30.0, 1.0), (49, 37.5, 0.8)]
same = found[24, False] == found[24, True] == right and [found[30, False], found[30, True]] == wrong
sys.exit(0 if same else "the behaviour has changed")
END
