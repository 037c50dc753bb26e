"""Films in USD as usd-core writes them, beside where float64 NumPy puts each vertex: rates, references, splines,
quaternions, skins and shapes."""

import os

import numpy as np
import pytest
from refusals import refused

from warpcage import Cage, PoseFile

pxr = pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

BOX = Cage.box([-1, -1, -1], [1, 1, 1])
POINTS, COUNT = BOX.vertices, len(BOX.vertices)
MOVE = np.array([0.5, 0.0, 0.25]) * (POINTS[:, 2:] + 1.0)  # a shape: the upper half goes aside
UPPER = (POINTS[:, 2] + 1.0) / 2.0  # shares of the second joint
PLACE = np.array([3.0, 1.0, 2.0])
KINDS = ("points", "shape", "skin", "moved")


def turned(degrees, points=POINTS, axis="z"):
    """Points about an axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y, z = points.T
    if axis == "z":
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)
    return np.stack([x, cosine * y - sine * z, sine * y + cosine * z], axis=1)


def placed(kind, value):
    """Where the vertices are at a value of a film: of a shape its weight, else degrees by 90."""
    if kind == "points":
        return POINTS + value * MOVE
    if kind == "shape":
        return POINTS + value * MOVE + PLACE
    if kind == "moved":
        return turned(90.0 * value) + PLACE
    joint = turned(90.0 * value, POINTS - [0, 0, 0.5], "x") + [0, 0, 0.5]  # about its head
    return POINTS + UPPER[:, None] * (joint - POINTS) + PLACE


def filmed(kind, values, *, rate=None, above=True, root="/set"):
    """A stage in memory with a film: values by time codes. above: whether what is skinned or shaped is placed."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Z")
    if rate is not None:
        stage.SetTimeCodesPerSecond(rate)
    top = (UsdSkel.Root if kind in ("shape", "skin") else UsdGeom.Xform).Define(stage, root)
    stage.SetDefaultPrim(top.GetPrim())
    if kind != "points" and above:
        top.AddTranslateOp().Set(tuple(PLACE))
    mesh = UsdGeom.Mesh.Define(stage, f"{root}/cage")
    mesh.CreatePointsAttr(POINTS)
    mesh.CreateFaceVertexCountsAttr([3] * len(BOX.faces))
    mesh.CreateFaceVertexIndicesAttr(np.ravel(BOX.faces).tolist())
    if kind == "points":
        for code, value in values.items():
            mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.float32(placed(kind, value))), code)
    elif kind == "moved":
        turn = top.AddRotateZOp()
        for code, value in values.items():
            turn.Set(90.0 * value, code)
    else:
        animation = skeleton_of(stage, mesh, root)
        if kind == "skin":
            animation.GetBlendShapeWeightsAttr().Set([0.0])
        for code, value in values.items():
            if kind == "shape":
                animation.GetBlendShapeWeightsAttr().Set([value], code)
            else:
                half = np.radians(45.0 * value)
                turn = Gf.Quatf(float(np.cos(half)), Gf.Vec3f(float(np.sin(half)), 0, 0))
                animation.GetRotationsAttr().Set([Gf.Quatf(1), turn], code)
    return stage


def skeleton_of(stage, mesh, root):
    """Two joints and a shape for a mesh. Returns their animation."""
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root}/bones")
    bind = [Gf.Matrix4d(1), Gf.Matrix4d(1).SetTranslate((0, 0, 0.5))]
    skeleton.CreateJointsAttr(["a", "a/b"])
    skeleton.CreateBindTransformsAttr(bind)
    skeleton.CreateRestTransformsAttr(bind)
    animation = UsdSkel.Animation.Define(stage, f"{root}/bones/film")
    animation.CreateJointsAttr(["a", "a/b"])
    animation.CreateTranslationsAttr([(0, 0, 0), (0, 0, 0.5)])
    animation.CreateRotationsAttr([Gf.Quatf(1)] * 2)
    animation.CreateScalesAttr([(1, 1, 1)] * 2)
    animation.CreateBlendShapesAttr(["up"])
    animation.CreateBlendShapeWeightsAttr()
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    shape = UsdSkel.BlendShape.Define(stage, f"{mesh.GetPath()}/up")
    shape.CreateOffsetsAttr(MOVE)
    shape.CreatePointIndicesAttr(list(range(COUNT)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateBlendShapesAttr(["up"])
    binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * COUNT)
    binding.CreateJointWeightsPrimvar(False, 2).Set(np.stack([1 - UPPER, UPPER], axis=1).ravel().tolist())
    return animation


def saved(stage, path):
    stage.GetRootLayer().Export(str(path))
    return path


def frames_of(path, rest=None):
    file = PoseFile.load(path, rest)
    times = np.array([file.times[name] for name in file.names])
    return file, times, np.stack([file[name].vertices for name in file.names])


@pytest.mark.parametrize("kind", KINDS)
def test_a_film_has_the_frames_and_the_rate_of_its_file(tmp_path, kind):
    """Of each rate, from frame 10 to 22, where nothing says the frames a second, as Blender writes it."""
    values = {10 + index: np.sin(index / 4.0) for index in range(13)}
    expected = np.stack([placed(kind, value) for value in values.values()])
    for rate in (24000 / 1001, 24, 25, 30000 / 1001, 30, 48, 50, 60000 / 1001, 60, 120, None):
        path = saved(filmed(kind, values, rate=rate), tmp_path / "film.usdc")
        file, times, frames = frames_of(path)
        assert file.fps == (rate or 24)
        np.testing.assert_allclose(times, np.arange(13) / (rate or 24), atol=1e-12)
        np.testing.assert_allclose(frames, expected, atol=2e-6)


@pytest.mark.parametrize("rate", [2.0, 8.0, 30000 / 1001, 300.0])
def test_rates_of_our_own_files_come_back(tmp_path, rate):
    file = PoseFile(BOX, {"a": BOX, "b": BOX.translate(PLACE)})
    file.times, file.fps = {"a": 0.0, "b": 6 / rate}, rate
    file.save(tmp_path / "a.usdc")
    back, times, frames = frames_of(tmp_path / "a.usdc")
    assert back.fps == rate and len(back) == 7
    np.testing.assert_allclose(times, np.arange(7) / rate)
    np.testing.assert_allclose(frames, np.stack([file.at_time(time).vertices for time in times]), atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "rate", "fps", "count"),
    [
        ((0, 12), 24, 24, 13),  # turned between keys, not straight
        ((3.5, 15.5), 30, 30, 13),  # frames that are no whole codes
        ((0, 20, 500), 1000, 50, 26),  # ticks: the rate is another
        ((0, 0.5, 1.25), 1, 24, 31),  # seconds
        ((0, 5.3, 12), 24, 24, 14),  # a key between two frames is kept beside them
    ],
)
@pytest.mark.parametrize("kind", ["skin", "moved"])
def test_what_turns_does_so_between_its_keys(tmp_path, kind, keys, rate, fps, count):
    path = saved(filmed(kind, {key: key / keys[-1] for key in keys}, rate=rate), tmp_path / "a.usda")
    file, times, frames = frames_of(path)
    assert (file.fps, len(file)) == (fps, count) and times[0] == 0.0
    np.testing.assert_allclose(times[-1], (keys[-1] - keys[0]) / rate)
    for time, frame in zip(times, frames, strict=True):
        np.testing.assert_allclose(frame, placed(kind, (keys[0] + time * rate) / keys[-1]), atol=4e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("own", "stage", "offset", "scale"),
    [(24, 24, 7.0, 1.0), (24, 24, -5.0, 2.0), (30, 24, 0.0, 1.0), (24, 60, 100.0, 0.5), (25, 30, 3.0, 1.0)],
)
@pytest.mark.parametrize("how", ["reference", "sublayer"])
def test_films_of_other_layers_come_at_their_times(tmp_path, kind, own, stage, offset, scale, how):
    """A code c of a layer is at offset + scale c (rate of the stage / its own)."""
    codes = np.arange(4.0, 17.0)
    part = saved(filmed(kind, {code: (code - 4) / 12 for code in codes}, rate=own), tmp_path / "part.usdc")
    made = Usd.Stage.CreateNew(str(tmp_path / "all.usda"))
    made.SetTimeCodesPerSecond(stage)
    UsdGeom.SetStageUpAxis(made, "Z")
    if how == "reference":
        made.DefinePrim("/world/it").GetReferences().AddReference("./part.usdc", Sdf.LayerOffset(offset, scale))
    else:
        made.GetRootLayer().subLayerPaths.append("./part.usdc")
        made.GetRootLayer().subLayerOffsets[0] = Sdf.LayerOffset(offset, scale)
    made.GetRootLayer().Save()
    assert part.exists()
    _, times, frames = frames_of(tmp_path / "all.usda")
    np.testing.assert_allclose(times[-1], scale * 12 / own, atol=1e-9)
    for time, frame in zip(times, frames, strict=True):
        share = time * own / scale / 12  # between two frames of its own it turns, or is straight
        np.testing.assert_allclose(frame, placed(kind, share), atol=4e-6)


# -- Splines

SPLINES = pytest.mark.skipif(Usd.GetVersion() < (0, 25, 11), reason="usd-core 25.11 evaluates splines")


def spline_of(knots, *, kind="float", after=None):
    """A spline of (time, value, slope to the next) knots; slope None is straight, "held" stays."""
    curves = pytest.importorskip("pxr.Ts")
    spline = curves.Spline(kind)
    for time, value, slope in knots:
        shape = {None: curves.InterpLinear, "held": curves.InterpHeld}.get(slope, curves.InterpCurve)
        knot = curves.Knot(typeName=kind, time=time, value=value, nextInterp=shape)
        if shape == curves.InterpCurve:
            knot.SetPreTanSlope(slope), knot.SetPostTanSlope(slope)
            knot.SetPreTanWidth(4.0), knot.SetPostTanWidth(4.0)
        spline.SetKnot(knot)
    if after is not None:
        spline.SetPostExtrapolation(curves.Extrapolation(getattr(curves, after)))
    return spline


def bezier(share):
    """The height at a share of the way of a cubic from 0 to 1 whose ends are flat, its tangents a third of the way."""
    return 3 * share**2 - 2 * share**3


@SPLINES
@pytest.mark.parametrize(
    ("knots", "after", "end", "angles"),
    [
        ([(0.0, 0.0, None), (12.0, 90.0, None)], None, None, [7.5 * code for code in range(13)]),
        ([(0.0, 0.0, 0.0), (12.0, 90.0, 0.0)], None, None, [90 * bezier(code / 12) for code in range(13)]),
        ([(0.0, 0.0, "held"), (4.0, 30.0, "held"), (6.0, 0.0, None)], None, None, [0] * 4 + [30] * 2 + [0]),
        ([(0.0, 0.0, None), (4.0, 40.0, None)], "ExtrapLoopRepeat", 7, [0, 10, 20, 30, 40, 50, 60, 70]),
        ([(0.0, 0.0, None), (4.0, 40.0, None)], "ExtrapLoopReset", 7, [0, 10, 20, 30, 0, 10, 20, 30]),
        ([(0.0, 0.0, None), (4.0, 40.0, None)], "ExtrapLinear", 6, [0, 10, 20, 30, 40, 50, 60]),
        ([(0.0, 0.0, None), (4.0, 40.0, None)], "ExtrapHeld", 6, [0, 10, 20, 30, 40]),
    ],
)
@pytest.mark.parametrize("kind", ["points", "skin"])
def test_films_by_splines_are_read(tmp_path, knots, after, end, angles, kind):
    """On what places a mesh, and on what places its skeleton; there are no samples of time in the file."""
    stage = filmed(kind, {}, rate=30, above=False)
    UsdGeom.Xformable(stage.GetPrimAtPath("/set")).AddRotateZOp().GetAttr().SetSpline(spline_of(knots, after=after))
    if end is not None:
        stage.SetStartTimeCode(0), stage.SetEndTimeCode(end)
    file, times, frames = frames_of(saved(stage, tmp_path / "a.usda"))
    assert file.fps == 30 and len(file) == len(angles)
    np.testing.assert_allclose(times, np.arange(len(angles)) / 30)
    np.testing.assert_allclose(frames, np.stack([turned(angle) for angle in angles]), atol=2e-5)


@SPLINES
def test_splines_of_other_layers_come_at_their_times(tmp_path):
    stage = filmed("points", {}, rate=12)
    turn = UsdGeom.Xformable(stage.GetPrimAtPath("/set")).AddRotateZOp(UsdGeom.XformOp.PrecisionDouble)
    turn.GetAttr().SetSpline(spline_of([(0.0, 0.0, None), (10.0, 50.0, None)], kind="double"))
    saved(stage, tmp_path / "part.usda")
    made = Usd.Stage.CreateNew(str(tmp_path / "all.usda"))
    made.SetTimeCodesPerSecond(24)
    UsdGeom.SetStageUpAxis(made, "Z")
    made.DefinePrim("/it").GetReferences().AddReference("./part.usda", Sdf.LayerOffset(100, 1))
    made.GetRootLayer().Save()
    file, times, frames = frames_of(tmp_path / "all.usda")
    assert len(file) == 21 and file.fps == 24
    np.testing.assert_allclose(frames, np.stack([turned(60.0 * time) for time in times]), atol=1e-6)


# -- Quaternions


@pytest.mark.parametrize(("kind", "error"), [("Half", 0.05), ("Float", 2e-5), ("Double", 1e-12)])
@pytest.mark.parametrize("inverse", [False, True])
def test_small_turns_of_quaternions_are_kept(tmp_path, kind, error, inverse):
    """USD's own matrix of a half quaternion stands still below 2.5 degrees; the file holds a turn to 0.05 degrees."""
    stage = filmed("points", {}, rate=24)
    turn = UsdGeom.Xformable(stage.GetPrimAtPath("/set")).AddOrientOp(getattr(UsdGeom.XformOp, f"Precision{kind}"))
    if inverse:
        UsdGeom.Xformable(stage.GetPrimAtPath("/set")).SetXformOpOrder(
            [UsdGeom.Xformable(stage.GetPrimAtPath("/set")).AddOrientOp(turn.GetPrecision(), "", True)]
        )
    quaternion, vector = {
        "Half": (Gf.Quath, Gf.Vec3h), "Float": (Gf.Quatf, Gf.Vec3f), "Double": (Gf.Quatd, Gf.Vec3d)
    }[kind]  # fmt: skip
    angles = [0.0, 0.02, 0.1, 1.0, 2.4, 3.0, 10.0, 44.0, 90.0, 135.0, 179.0]
    for code, angle in enumerate(angles):
        half = np.radians(angle / 2)
        turn.Set(quaternion(float(np.cos(half)), vector(0, 0, float(np.sin(half)))), code)
    _, _, frames = frames_of(saved(stage, tmp_path / "a.usdc"))
    found = np.degrees(np.arctan2(frames[:, :, 1], frames[:, :, 0]) - np.arctan2(POINTS[:, 1], POINTS[:, 0]))
    off = (found * (-1 if inverse else 1) - np.array(angles)[:, None] + 180.0) % 360.0 - 180.0
    assert np.abs(off).max() < error
    assert np.abs(off[1:5] / np.array(angles[1:5])[:, None]).max() < 1e-3


# -- What stands still


def test_a_film_rests_where_it_begins(tmp_path):
    """Blender writes the place of what moves as samples alone: it is not at the origin for that."""
    stage = filmed("moved", {5: 0.0, 17: 1.0})
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/set")).GetOrderedXformOps()[0]
    place.GetAttr().Clear()
    place.Set(tuple(PLACE), 5)
    np.testing.assert_allclose(Cage.load(saved(stage, tmp_path / "a.usda")).vertices, placed("moved", 0.0), atol=1e-6)


def test_a_skin_rests_where_its_bones_were_bound(tmp_path):
    """Of a film; what has one pose is shown in it. The mesh's own place does not count, its binding does."""
    for name, values in (("film", {0: 1.0, 5: -1.0}), ("pose", {0: 1.0})):
        stage = filmed("skin", values)
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/set/cage"))
        mesh.AddTranslateOp().Set((9, 9, 9))
        mesh.GetPointsAttr().Set(POINTS * 100)
        UsdSkel.BindingAPI(mesh).CreateGeomBindTransformAttr(Gf.Matrix4d(1).SetScale(0.01))
        rest = Cage.load(saved(stage, tmp_path / f"{name}.usdc"))
        expected = POINTS + PLACE if name == "film" else placed("skin", 1.0)
        np.testing.assert_allclose(rest.vertices, expected, atol=1e-5)
    np.testing.assert_allclose(frames_of(tmp_path / "film.usdc")[2][-1], placed("skin", -1.0), atol=1e-5)


def test_shapes_without_values_are_poses(tmp_path):
    """As Blender writes them without "Animation" among its options: none of their values is in the file."""
    stage = filmed("shape", {})
    path = saved(stage, tmp_path / "a.usdc")
    with pytest.warns(UserWarning, match="its shapes have no values.*up"):
        file = PoseFile.load(path)
    assert file.names == ("up",) and not file.times
    np.testing.assert_allclose(file["up"].vertices, placed("shape", 1.0), atol=1e-6)
    with pytest.warns(UserWarning, match="its shapes have no values"):
        rest = Cage.load(path)
    np.testing.assert_allclose(rest.vertices, placed("shape", 0.0), atol=1e-6)
    refused(lambda: PoseFile.load(path, rest, name="down"), match="only the shapes up")
    stage.GetPrimAtPath("/set/bones/film").GetAttribute("blendShapeWeights").Set([0.5])  # a value: it is shown
    rest = Cage.load(saved(stage, tmp_path / "b.usdc"))
    np.testing.assert_allclose(rest.vertices, placed("shape", 0.5), atol=1e-6)
    assert PoseFile.load(tmp_path / "b.usdc").names == ("b",)
    np.testing.assert_allclose(
        PoseFile.load(tmp_path / "b.usdc", name="up")["up"].vertices, placed("shape", 1), atol=1e-6
    )


def test_instances_of_a_skin_move(tmp_path):
    values = {code: code / 4 for code in range(5)}
    saved(filmed("skin", values, rate=30), tmp_path / "part.usdc")
    made = Usd.Stage.CreateNew(str(tmp_path / "all.usda"))
    made.SetTimeCodesPerSecond(30)
    UsdGeom.SetStageUpAxis(made, "Z")
    for index in range(2):
        prim = UsdGeom.Xform.Define(made, f"/two/at{index}")
        prim.AddTranslateOp().Set((0, 10 * index, 0))
        inside = made.DefinePrim(f"/two/at{index}/it")
        inside.GetReferences().AddReference("./part.usdc")
        inside.SetInstanceable(True)
    made.GetRootLayer().Save()
    _, _, frames = frames_of(tmp_path / "all.usda", Cage.load(tmp_path / "all.usda", object="*"))
    for code, frame in enumerate(frames):
        expected = placed("skin", values[code])
        np.testing.assert_allclose(frame, np.concatenate([expected, expected + [0, 10, 0]]), atol=4e-6)


def test_a_file_that_is_another_one_by_now_is_read_anew(tmp_path):
    """USD keeps the layers of stages that somebody holds; edits that were not saved stay."""
    path = tmp_path / "a.usda"
    Cage.box([0, 0, 0], [1, 1, 1]).save(path)
    held = Usd.Stage.Open(str(path))
    Cage.box([0, 0, 0], [3, 3, 3]).save(path)
    os.utime(path, (2e9, 2e9))
    assert Cage.load(path).vertices.max() == 3.0
    held.GetDefaultPrim().SetCustomDataByKey("mine", 1)
    Cage.load(path)
    assert held.GetDefaultPrim().GetCustomDataByKey("mine") == 1


def test_what_point_instancers_place_is_not_read_and_said(tmp_path):
    stage = filmed("points", {})
    stage.DefinePrim("/set/leaves", "PointInstancer")
    UsdGeom.Mesh.Define(stage, "/set/leaves/leaf").CreatePointsAttr(POINTS)
    with pytest.warns(UserWarning, match=r"is not read .leaves."):
        assert len(Cage.load(saved(stage, tmp_path / "a.usda")).vertices) == COUNT


@pytest.mark.parametrize(
    ("kind", "old", "new", "message"),
    [
        ("shape", "pointIndices = [0,", "pointIndices = [99,", "its shapes do not fit"),
        ("shape", "pointIndices = [0,", "pointIndices = [-1,", "its shapes do not fit"),
        ("shape", '"up"]\n        rel', '"up", "side"]\n        rel', "its shapes do not fit"),
        ("shape", "4: [1]", "4: [inf]", "not finite"),
        ("skin", "jointIndices = [0,", "jointIndices = [9,", "its skeleton do not fit"),
        ("skin", "elementSize = 2", "elementSize = 3", "its skeleton do not fit"),
        ("moved", "4: 90", "1e9: 90", "frames, at most 20000"),
        ("moved", "upAxis", "timeCodesPerSecond = 0\n    upAxis", "0 time codes a second"),
        ("moved", "upAxis", "timeCodesPerSecond = -24\n    upAxis", "-24 time codes a second"),
    ],
)
def test_films_that_cannot_be_are_refused_in_one_line(tmp_path, kind, old, new, message):
    path = saved(filmed(kind, {0: 0.5, 4: 1.0}), tmp_path / "bad.usda")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refused(lambda: PoseFile.load(path), "bad.usda", match=message)
