"""Splats in stages of USD, written by usd-core as its schema says them, against float64; what is written has bounds."""

import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest
from field_oracles import basis
from refusals import refused
from scipy.spatial.transform import Rotation
from splat_scenes import field_of, loaded, require_usd, some_splats

import warpcage
from warpcage.splats import is_splat_file, rotation_matrices
from warpcage.studio.cli import main

require_usd()
from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

#: From y up and z to the back, and from z up, to a field's axes: x right, y down, z to the front.
AXES = {"Y": np.diag([1.0, -1, -1]), "Z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}

#: Names of the attributes; those of half floats end in h.
PLACES, TURNS, SCALES, OPACITIES = "positions", "orientations", "scales", "opacities"
DEGREE, HARMONICS = "radiance:sphericalHarmonicsDegree", "radiance:sphericalHarmonicsCoefficients"


def values_of(count=5, degree=2, seed=0):
    """Values of a prim as the schema has them: activated, quaternions w x y z, harmonics a splat after the other."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    return {
        PLACES: rng.uniform(-2, 2, (count, 3)),
        TURNS: turns / np.linalg.norm(turns, axis=1, keepdims=True),
        SCALES: rng.uniform(0.05, 0.4, (count, 3)),
        OPACITIES: rng.uniform(0.1, 0.9, count),
        DEGREE: degree,
        HARMONICS: rng.normal(size=(count * (degree + 1) ** 2, 3)),
    }


def set_values(prim, values, half=False, time=None):
    kinds = {PLACES: "Vec3", SCALES: "Vec3", HARMONICS: "Vec3", OPACITIES: "Half" if half else "Float", TURNS: "Quat"}
    time = Usd.TimeCode.Default() if time is None else time
    for name, value in values.items():
        if name == DEGREE:
            prim.GetAttribute(name).Set(value)
            continue
        letter = "h" if half else "f"
        if name == TURNS:
            quaternion = Gf.Quath if half else Gf.Quatf
            held = [quaternion(*map(float, row)) for row in value]
        else:
            kind = kinds[name] if name == OPACITIES else f"Vec3{letter}"
            held = getattr(Vt, f"{kind}Array").FromNumpy(np.ascontiguousarray(value, f"f{2 if half else 4}"))
        prim.GetAttribute(name + "h" * half).Set(held, time)


def new_stage(path, up="Y"):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    return stage


def splats_at(stage, place, values, **options):
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, place)
    set_values(prim.GetPrim(), values, **options)
    return prim


def assert_is(field, values, moved=None, up="Y", atol=1e-5):
    """A field holds values that a matrix (4, 4), for columns, moved in a stage with an axis up."""
    matrix = np.eye(4)
    matrix[:3, :3] = AXES[up]
    matrix = matrix @ (np.eye(4) if moved is None else moved)
    axes, scale = matrix[:3, :3], np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
    np.testing.assert_allclose(field.centers, values[PLACES] @ axes.T + matrix[:3, 3], atol=atol)
    turns = axes @ rotation_matrices(values[TURNS])
    shapes = np.einsum("nab,nb,ncb->nac", turns, values[SCALES] ** 2, turns)
    np.testing.assert_allclose(field.covariances, shapes, atol=atol)
    np.testing.assert_allclose(field.opacities, values[OPACITIES], atol=atol)
    along = np.random.default_rng(1).normal(size=(20, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    degree = values[DEGREE]
    assert field.degree == degree
    rows = values[HARMONICS].reshape(-1, (degree + 1) ** 2, 3)
    for direction in along:  # a colour that was seen along d is seen along M d
        before = basis((direction @ axes / scale)[None], degree + 1)[0]
        seen = np.einsum("b,nbc->nc", basis(direction[None], degree + 1)[0], field.contents.harmonics)
        np.testing.assert_allclose(seen, np.einsum("b,nbc->nc", before, rows), atol=10 * atol)


@pytest.mark.parametrize("ending", ["usda", "usdc"])
@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_stage_of_usd_core(tmp_path, ending, up, degree):
    path, values = tmp_path / f"a.{ending}", values_of(degree=degree)
    stage = new_stage(path, up)
    splats_at(stage, "/a", values)
    stage.Save()
    assert is_splat_file(path)
    assert_is(loaded(path), values, up=up)


def test_half_floats_are_read_and_floats_preferred(tmp_path):
    values = values_of()
    stage = new_stage(tmp_path / "a.usdc")
    splats_at(stage, "/a", values, half=True)
    stage.Save()
    assert_is(loaded(tmp_path / "a.usdc"), values, atol=2e-3)
    other = values_of(seed=3)
    set_values(stage.GetPrimAtPath("/a"), other)
    stage.Save()
    assert_is(loaded(tmp_path / "a.usdc"), other)


def test_prims_are_at_their_places(tmp_path):
    """Turned, mirrored, evenly scaled and moved by the prim and what is above it; instances; a field of two degrees."""
    path, values, others = tmp_path / "a.usda", values_of(), values_of(3, degree=1, seed=5)
    stage = new_stage(path)
    above = UsdGeom.Xform.Define(stage, "/above")
    above.AddTranslateOp().Set((1, 2, 3))
    above.AddRotateXYZOp().Set((20, 40, 60))
    above.AddScaleOp().Set((2, 2, -2))
    below = splats_at(stage, "/above/a", values)
    below.AddTranslateOp().Set((-1, 0, 0.5))
    below.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(0.5, 0.5, -0.5, 0.5))
    source = stage.CreateClassPrim("/source")
    splats_at(stage, "/source/b", others)
    for name, x in (("one", 10), ("two", 20)):
        copy = UsdGeom.Xform.Define(stage, f"/{name}")
        copy.AddTranslateOp().Set((x, 0, 0))
        copy.GetPrim().GetReferences().AddInternalReference(source.GetPath())
        copy.GetPrim().SetInstanceable(True)
    stage.Save()
    field = loaded(path)
    assert field.splat_count == 5 + 2 * 3

    def matrix(turn, scales, place):
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = turn.as_matrix() * scales, place
        return whole

    first = matrix(Rotation.from_euler("xyz", [20, 40, 60], degrees=True), [2, 2, -2], [1, 2, 3])
    second = matrix(Rotation.from_quat([0.5, -0.5, 0.5, 0.5]), [1, 1, 1], [-1, 0, 0.5])
    assert_is_part = {(0, 5): (values, first @ second), (5, 8): (others, None), (8, 11): (others, None)}
    for (begin, end), (held, moved) in assert_is_part.items():
        part = field.chosen(np.arange(begin, end))
        if moved is None:
            moved = np.eye(4)
            moved[0, 3] = 10 if begin == 5 else 20
        held = held | {DEGREE: 2}
        rows = held[HARMONICS].reshape(end - begin, -1, 3)
        held[HARMONICS] = np.pad(rows, ((0, 0), (0, 9 - rows.shape[1]), (0, 0))).reshape(-1, 3)
        assert_is(part, held, moved)


def test_what_the_schema_leaves_out_is_usual(tmp_path):
    """Scales of one, opaque, grey and not turned; values beyond the last splat are left out with a warning."""
    stage = new_stage(tmp_path / "a.usda")
    splats_at(stage, "/a", {PLACES: np.eye(3)})
    stage.Save()
    field = loaded(tmp_path / "a.usda")
    np.testing.assert_array_equal(field.scales, 1.0)
    np.testing.assert_array_equal(field.opacities, 1.0)
    np.testing.assert_array_equal(field.contents.harmonics, np.zeros((3, 1, 3)))
    np.testing.assert_array_equal(field.covariances, np.tile(np.eye(3), (3, 1, 1)))
    stage.GetPrimAtPath("/a").GetAttribute(OPACITIES).Set([0.5, 0.25, 0.75, 0.1])
    stage.Save()
    with pytest.warns(UserWarning, match="of 4 opacities the first 3 are read"):
        np.testing.assert_allclose(loaded(tmp_path / "a.usda").opacities, [0.5, 0.25, 0.75])


def test_what_moves_is_read_as_it_begins(tmp_path):
    path, values = tmp_path / "a.usda", values_of()
    stage = new_stage(path)
    prim = splats_at(stage, "/a", values)
    prim.AddTranslateOp().Set((5, 0, 0), 3.0)
    stage.Save()
    moved = np.eye(4)
    moved[0, 3] = 5
    assert_is(loaded(path), values, moved)  # one time alone: it stands still
    set_values(prim.GetPrim(), {PLACES: values[PLACES] + 1}, time=8.0)
    stage.Save()
    with pytest.warns(UserWarning, match="change, at 2 times: .* or else at 3"):
        assert loaded(path).splat_count == 5


def beside_a_lost_one(prim):
    prim.GetStage().DefinePrim("/lost").GetReferences().AddReference("./lost.usda")


def beside_a_hidden_one(prim):
    UsdGeom.Imageable(splats_at(prim.GetStage(), "/hidden/b", values_of())).MakeInvisible()


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda prim: prim.GetAttribute("projectionModeHint").Set("tangential"), "projectionModeHint 'tangential'"),
        (
            lambda prim: Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr("lin_rec709_scene"),
            "'lin_rec709_scene', which are taken as",
        ),
        (lambda prim: prim.GetAttribute(HARMONICS).SetColorSpace("lin_rec709_scene"), "colours in 'lin_rec709"),
        (beside_a_lost_one, "1 part of its stage cannot .*lost.usda"),
        (beside_a_hidden_one, "1 of 2 prims with splats is invisible"),
    ],
)
def test_what_is_drawn_otherwise_is_told(tmp_path, change, said):
    stage = new_stage(tmp_path / "a.usda")
    change(splats_at(stage, "/a", values_of()).GetPrim())
    stage.Save()
    with pytest.warns(UserWarning, match=said):
        assert loaded(tmp_path / "a.usda").splat_count == 5


def test_colors_of_pictures_say_nothing(tmp_path, recwarn):
    for name in ("srgb_rec709_scene", "srgb_rec709_display"):  # the second by 3DGRUT and Blender
        stage = new_stage(tmp_path / f"{name}.usda")
        Usd.ColorSpaceAPI.Apply(splats_at(stage, "/a", values_of()).GetPrim()).CreateColorSpaceNameAttr(name)
        stage.Save()
        assert_is(loaded(tmp_path / f"{name}.usda"), values_of())
    assert not len(recwarn)


def uneven(prim):
    UsdGeom.Xformable(prim).AddScaleOp().Set((1, 2, 1))


def put(name, values):
    def change(prim):
        set_values(prim, {name: values})

    return change


REFUSED = [
    (put(DEGREE, 4), "prim /a: .* of degree 0 to 3, got 4"),
    (put(DEGREE, -1), "degree 0 to 3, got -1"),
    (put(DEGREE, 3), "prim /a: 5 splats need 80 .*, got 45"),
    (put(SCALES, np.ones((4, 3))), "5 splats need 5 scales, got 4"),
    (put(SCALES, np.full((5, 3), -3.0)), "scales must be above 0, got -3"),
    (put(OPACITIES, [2.5, 0, 0, 0, -4.0]), r"opacities must be in \[0, 1\], got -4"),
    (put(PLACES, np.full((5, 3), np.nan)), "not finite"),
    (uneven, "prim /a stretches its splats unevenly"),
    (lambda prim: UsdGeom.Xformable(prim).AddScaleOp().Set((0, 0, 0)), "prim /a stretches its splats unevenly"),
    (lambda prim: UsdGeom.Xformable(prim).AddScaleOp().Set((np.inf,) * 3), "prim /a is at no place"),
    (lambda prim: UsdGeom.Imageable(prim).MakeInvisible(), "is invisible: make one visible"),
    (lambda prim: prim.SetTypeName("Points"), "it has no splats: no prim"),
]


@pytest.mark.parametrize("change, said", REFUSED)
def test_stages_that_are_refused(tmp_path, change, said):
    stage = new_stage(tmp_path / "a.usdc")
    change(splats_at(stage, "/a", values_of()).GetPrim())
    stage.Save()
    refused(lambda: loaded(tmp_path / "a.usdc"), "a.usdc", match=said)


@pytest.mark.parametrize("ending", [".usda", ".usdz"])
def test_what_is_written_is_bounded_and_says_its_colors(tmp_path, ending):
    field = field_of(some_splats(20))
    field.save(tmp_path / f"a{ending}")
    stage = Usd.Stage.Open(str(tmp_path / f"a{ending}"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and UsdGeom.GetStageUpAxis(stage) == "Y"
    assert Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None) == "srgb_rec709_scene"
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(prim).ComputeAlignedRange()
    centers = field.centers @ AXES["Y"].T
    reach = 3 * np.sqrt(np.einsum("ab,nbc,ac->na", AXES["Y"], field.covariances, AXES["Y"]))
    np.testing.assert_allclose(box.GetMin(), (centers - reach).min(axis=0), atol=1e-4)
    np.testing.assert_allclose(box.GetMax(), (centers + reach).max(axis=0), atol=1e-4)


def test_far_from_the_origin_nothing_is_rounded(tmp_path, recwarn):
    field = field_of(some_splats(20))
    far = warpcage.SplatField.from_arrays(
        field.centers.astype(np.float64) + [5e6, -4e6, 100],
        field.scales,
        field.rotations,
        field.opacities,
        harmonics=field.contents.harmonics,
        device="cpu",
    )
    far.save(tmp_path / "a.usdc")
    np.testing.assert_allclose(loaded(tmp_path / "a.usdc").contents.centers, far.contents.centers, atol=2e-6)
    assert not len(recwarn)


def test_meshes_and_damaged_files_are_no_splats(tmp_path):
    warpcage.Cage.box((0, 0, 0), (1, 1, 1)).save(tmp_path / "cage.usdc")
    (tmp_path / "bad.usdc").write_bytes(b"PXR-USDC")
    assert not is_splat_file(tmp_path / "cage.usdc") and not is_splat_file(tmp_path / "bad.usdc")
    refused(lambda: loaded(tmp_path / "cage.usdc"), match="cage.usdc: it has no splats")
    assert len(warpcage.Cage.load(tmp_path / "cage.usdc").vertices) == 8


def test_without_the_schema_it_is_said_what_to_install(tmp_path, monkeypatch):
    field_of(some_splats(3)).save(tmp_path / "a.usdc")
    monkeypatch.delattr(UsdVol, "ParticleField3DGaussianSplat")
    for attempt in (lambda: loaded(tmp_path / "a.usdc"), lambda: field_of(some_splats(3)).save(tmp_path / "b.usdc")):
        refused(attempt, match="usd-core 26.3 or later", error=ImportError)
    assert is_splat_file(tmp_path / "a.usdc") and not (tmp_path / "b.usdc").exists()


def test_info_names_what_a_stage_holds(tmp_path, capsys):
    stage = new_stage(tmp_path / "a.usda")
    splats_at(stage, "/a", values_of())
    for name in ("/front", "/back"):
        UsdGeom.Camera.Define(stage, name)
    stage.Save()
    assert main(["info", str(tmp_path / "a.usda")]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"kind +splats\n", printed) and re.search(r"holds +2 cameras, 1 prim of splats\n", printed)
    stage.RemovePrim("/a")
    stage.Save()
    assert main(["info", str(tmp_path / "a.usda")]) == 0
    assert re.search(r"kind +USD stage\nholds +2 cameras\n", capsys.readouterr().out)
    warpcage.Cage.box((0, 0, 0), (1, 1, 1)).save(tmp_path / "box.usdc")
    mesh = stage.DefinePrim("/mesh")
    mesh.GetReferences().AddReference("./box.usdc")
    stage.SetTimeCodesPerSecond(30)
    move = UsdGeom.Xformable(mesh).AddTranslateOp()
    for code in (1, 2, 31):
        move.Set((0, 0, code), code)
    stage.Save()
    assert main(["info", str(tmp_path / "a.usda")]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"kind +cage\nholds +1 mesh, 2 cameras\nmoves +31 frames in 1 s, 30 a second\n", printed)


def test_info_counts_frames_of_gltf(capsys):
    assert main(["info", str(pathlib.Path(__file__).parents[2] / "data/blender_motion/armature.glb")]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"holds +1 mesh, 1 skeleton\n", printed) and re.search(r"animation '.*' +\d+ frames in", printed)


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_what_gsplat2usd_makes_of_an_spz_file_is_the_same_splats(tmp_path, ending):
    """NVIDIA's converter: y up as SPZ has it, nothing is turned."""
    pytest.importorskip("gsplat2USD")
    field_of(some_splats(50)).save(tmp_path / "a.spz")
    run = [sys.executable, "-m", "gsplat2USD", "-i", tmp_path / "a.spz", "-o", tmp_path / f"a.{ending}"]
    subprocess.run(run, check=True, capture_output=True)
    field, found = loaded(tmp_path / "a.spz"), loaded(tmp_path / f"a.{ending}")
    np.testing.assert_array_equal(found.contents.centers, field.contents.centers)
    np.testing.assert_allclose(found.covariances, field.covariances, atol=1e-7)
    np.testing.assert_allclose(found.opacities, field.opacities, atol=1e-6)
    np.testing.assert_allclose(found.contents.harmonics, field.contents.harmonics, atol=1e-6)
