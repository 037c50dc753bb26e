"""Cages and meshes that move, in glTF and USD, read by trimesh, usd-core and the specification alone, and back."""

import json
import sys

import numpy as np
import pytest
from refusals import refused
from runs import succeed, write_files

from warpcage import Cage, PoseFile, VoxelField, deform_points
from warpcage.edits import carried_points
from warpcage.mesh import write_shown_mesh

BOX = Cage.box([1000, 0, 0], [1002, 1, 1], segments=3)
GLTF, USD = (".glb", ".gltf"), (".usd", ".usda", ".usdc")
FPS = 24


def film():
    file = PoseFile(BOX, {"rest": BOX, "twisted": BOX.twist(70, axis="x"), "bent": BOX.bend(40, axis="x", towards="z")})
    file.times, file.fps = {"rest": 0.0, "twisted": 0.5, "bent": 1.25}, float(FPS)
    return file


def frames_of(file):
    return np.stack([file.at_time(index / FPS).vertices for index in range(round(file.length * FPS) + 1)])


def gltf_frames(path):
    """Frames (n, v, 3), z up, and times of a .gltf file of one mesh, by the specification of glTF 2.0 alone."""
    import base64

    document = json.loads(path.read_text())
    data = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])

    def values(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        assert accessor["componentType"] == 5126
        found = np.frombuffer(data, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        if "min" in accessor:
            np.testing.assert_array_equal([accessor["min"], accessor["max"]], [found.min(axis=0), found.max(axis=0)])
        return found.astype(float)

    (mesh,), (node,), (animation,) = document["meshes"], document["nodes"], document["animations"]
    (primitive,), (sampler,) = mesh["primitives"], animation["samplers"]
    shapes = np.stack([values(target["POSITION"]) for target in primitive["targets"]])
    weights = values(sampler["output"]).reshape(-1, len(shapes))
    assert weights.min() >= 0.0 and weights.max() <= 1.0 and len(mesh["weights"]) == len(shapes)
    assert animation["channels"] == [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]
    base = values(primitive["attributes"]["POSITION"])
    x, y, z = np.moveaxis(base + np.einsum("nk,kvi->nvi", weights, shapes) + node.get("translation", [0, 0, 0]), -1, 0)
    return np.stack([x, -z, y], axis=-1), values(sampler["input"])[:, 0], len(shapes)


def usd_frames(path):
    """Frames (n, v, 3), their times, and the values of the mesh of a USD file, by usd-core."""
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = usd.Stage.Open(str(path))
    assert geometry.GetStageUpAxis(stage) == "Z" and geometry.GetStageMetersPerUnit(stage) == 1.0
    mesh = geometry.Mesh(stage.GetDefaultPrim())
    codes = mesh.GetPointsAttr().GetTimeSamples()
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == ((codes[0], codes[-1]) if codes else (0.0, 0.0))
    assert stage.GetFramesPerSecond() == stage.GetTimeCodesPerSecond()
    place = np.array(mesh.ComputeLocalToWorldTransform(0.0))[3, :3]
    frames = [np.array(mesh.GetPointsAttr().Get(code), float) for code in codes]
    for code, points in zip(codes, frames, strict=True):
        np.testing.assert_array_equal(mesh.GetExtentAttr().Get(code), [points.min(axis=0), points.max(axis=0)])
    colors = mesh.GetDisplayColorPrimvar()
    held = {name: np.array(mesh.GetPrim().GetAttribute(name).Get()) for name in ("points", "faceVertexIndices")}
    held |= {"color": np.array(colors.Get()), "color at": colors.GetInterpolation()}
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none" and set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    return np.stack(frames) + place if codes else None, np.array(codes) / stage.GetTimeCodesPerSecond(), held


@pytest.mark.parametrize("ending", [*GLTF, *USD])
def test_a_film_of_a_cage_comes_back(tmp_path, ending):
    """Far from the origin, with the order of vertices, up to a millionth of its size."""
    if ending in USD:
        pytest.importorskip("pxr")
    path, file = tmp_path / f"walk{ending}", film()
    file.save(path)
    rest, back = Cage.load(path), PoseFile.load(path)
    np.testing.assert_array_equal(rest.faces, BOX.faces)
    np.testing.assert_allclose(rest.vertices, BOX.vertices, atol=2e-6)
    found = np.stack([back[name].vertices for name in back.timed])
    np.testing.assert_allclose(found, frames_of(file), atol=4e-6)
    np.testing.assert_allclose(sorted(back.times.values()), np.arange(31) / FPS)
    assert back.fps == FPS
    shuffled = Cage(BOX.vertices[::-1], len(BOX.vertices) - 1 - BOX.faces)
    np.testing.assert_allclose(PoseFile.load(path, shuffled)["frame 31"].vertices, found[-1][::-1], atol=1e-9)


def test_gltf_holds_a_film_as_shapes_that_are_few(tmp_path):
    file = film()
    file.save(tmp_path / "walk.gltf")
    frames, times, shapes = gltf_frames(tmp_path / "walk.gltf")
    np.testing.assert_allclose(frames, frames_of(file), atol=4e-6)
    np.testing.assert_allclose(times, np.arange(31) / FPS, atol=1e-7)
    assert shapes <= 4  # of 31 frames between a cage at rest and two others


def test_trimesh_reads_the_cage_at_rest_of_a_film(tmp_path):
    import trimesh

    film().save(tmp_path / "walk.glb")
    mesh = trimesh.load(tmp_path / "walk.glb", force="mesh", process=False)
    assert mesh.volume == pytest.approx(2.0, rel=1e-5) and len(mesh.vertices) == len(BOX.vertices)


@pytest.mark.parametrize("ending", USD)
def test_usd_holds_a_film_as_time_samples(tmp_path, ending):
    pytest.importorskip("pxr")
    film().save(tmp_path / f"walk{ending}")
    frames, times, held = usd_frames(tmp_path / f"walk{ending}")
    np.testing.assert_allclose(frames, frames_of(film()), atol=2e-7)
    np.testing.assert_allclose(times, np.arange(31) / FPS)
    np.testing.assert_array_equal(held["faceVertexIndices"].reshape(-1, 3), BOX.faces)
    assert (tmp_path / f"walk{ending}").read_bytes().startswith(b"#usda" if ending == ".usda" else b"PXR-USDC")


def test_frames_of_any_motion_are_kept(tmp_path):
    """A shape a frame, and one that is always on, where none is a mixture of others; one where all stands still."""
    random = np.random.default_rng(0)
    frames = BOX.vertices + random.normal(size=(7, *BOX.vertices.shape))
    write_shown_mesh(tmp_path / "a.gltf", BOX.vertices, BOX.faces, frames=frames, fps=12)
    found, times, shapes = gltf_frames(tmp_path / "a.gltf")
    np.testing.assert_allclose(found, frames, atol=1e-5)
    assert shapes == 8 and times[-1] == 0.5
    write_shown_mesh(tmp_path / "still.gltf", BOX.vertices, BOX.faces, frames=np.stack([BOX.vertices] * 3))
    np.testing.assert_allclose(gltf_frames(tmp_path / "still.gltf")[0][2], BOX.vertices, atol=2e-6)
    refused(lambda: write_shown_mesh(tmp_path / "a.obj", BOX.vertices, BOX.faces, frames=frames), match="motion")


# -- The surface of a field, posed in one step


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("files"))
    rest, posed = Cage.load(folder / "cage.obj"), Cage.load(folder / "posed.obj")
    file = PoseFile(rest, {"a": rest, "b": posed})
    file.times, file.fps = {"a": 0.0, "b": 0.5}, 12.0
    file.save(folder / "poses.json")
    return folder


def carried(files, pose, kind="harmonic"):
    mesh = VoxelField.load(files / "ball.npz").extract_mesh(colors=True)
    rest = Cage.load(files / "cage.obj")
    return deform_points(np.asarray(mesh.vertices), rest, pose, kind), mesh


@pytest.mark.parametrize("ending", [".ply", ".glb", ".usdc"])
def test_a_posed_mesh_in_one_step(files, ending, capsys):
    import trimesh

    if ending in USD:
        pytest.importorskip("pxr")
    options = ["--cage", "@cage.obj", "--posed", "@posed.obj", "--coordinates", "green"]
    succeed(files, "mesh", "@ball.npz", *options, "-o", f"@posed{ending}")
    assert "frames" not in capsys.readouterr().out
    expected, _ = carried(files, Cage.load(files / "posed.obj"), "green")
    if ending in USD:
        found = usd_frames(files / f"posed{ending}")[2]["points"]
    else:
        found = trimesh.load(files / f"posed{ending}", force="mesh", process=False).vertices
    x, y, z = np.transpose(found)
    found = np.stack([x, -z, y], axis=1) if ending == ".glb" else found
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_a_film_of_a_mesh_keeps_its_colors(files):
    pytest.importorskip("pxr")
    options = ["--cage", "@cage.obj", "--posed", "@poses.json", "--coordinates", "mean_value"]
    succeed(files, "mesh", "@ball.npz", *options, "-o", "@walk.gltf")
    succeed(files, "mesh", "@ball.npz", *options, "-o", "@walk.usdc")
    frames, times, held = usd_frames(files / "walk.usdc")
    np.testing.assert_allclose(times, np.arange(7) / 12)
    film = PoseFile.load(files / "poses.json")
    expected, at_rest = carried(files, film.at_time(times[4]), "mean_value")
    np.testing.assert_allclose(frames[4], expected, atol=2e-6)
    np.testing.assert_allclose(gltf_frames(files / "walk.gltf")[0], frames, atol=5e-6)
    srgb = np.asarray(at_rest.visual.vertex_colors)[:, :3] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(held["color"], linear, atol=1e-6)
    assert held["color at"] == "vertex" and np.ptp(linear, axis=0).max() > 0.5


def test_frames_of_poses_without_times(files):
    succeed(
        files, "mesh", "@ball.npz", "--cage", "@cage.obj", "--posed", "@posed.obj", "--frames", "5", "-o", "@f.gltf"
    )
    frames, times, _ = gltf_frames(files / "f.gltf")
    expected, at_rest = carried(files, Cage.load(files / "posed.obj"))
    np.testing.assert_allclose(frames[[0, 4]], [at_rest.vertices, expected], atol=4e-6)
    np.testing.assert_allclose(times, np.arange(5) / FPS, atol=1e-7)


def test_a_pose_file_becomes_a_cage_that_moves(files, capsys):
    succeed(files, "pose", "@cage.obj", "--posed", "@poses.json", "--fps", "24", "-o", "@cage_walk.glb")
    back = PoseFile.load(files / "cage_walk.glb", Cage.load(files / "cage.obj"))
    posed = Cage.load(files / "posed.obj").vertices
    assert len(back) == 13
    np.testing.assert_allclose(back["frame 13"].vertices, posed, atol=2e-6)


def test_edits_take_points_along_one_after_the_other(device):
    from warpcage import CageEdit

    one, two = Cage.box([0, 0, 0], [1, 1, 1]), Cage.box([2, 0, 0], [3, 1, 1])
    points = np.array([[0.5, 0.5, 0.5], [2.5, 0.5, 0.5], [5.0, 5, 5]])
    poses = [one.translate([2, 0, 0]), two.translate([0, 0, 4])]
    found = carried_points(points, [CageEdit(one), CageEdit(two)], poses, coordinates="mean_value", device=device)
    np.testing.assert_allclose(found, [[2.5, 0.5, 4.5], [2.5, 0.5, 4.5], [5, 5, 5]], atol=1e-5)


# -- USD of other programs


def written_stage(path, *, up="Y", orientation="rightHanded"):
    """A box of quads as another program has it: below an object that is placed and turns, in its own axes."""
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = usd.Stage.CreateNew(str(path))
    geometry.SetStageUpAxis(stage, up)
    stage.SetTimeCodesPerSecond(25)
    root = geometry.Xform.Define(stage, "/set")
    stage.SetDefaultPrim(root.GetPrim())
    place = geometry.Xform.Define(stage, "/set/Body")
    place.AddTranslateOp().Set((0, 3, 0))
    turn = place.AddRotateYOp()
    for code, angle in ((0, 0.0), (4, 60.0)):
        turn.Set(angle, code)
    mesh = geometry.Mesh.Define(stage, "/set/Body/Cube_001")
    corners = [(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 4)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    if orientation == "leftHanded":
        quads = [quad[::-1] for quad in quads]
    mesh.CreatePointsAttr(corners)
    mesh.CreateOrientationAttr(orientation)
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr(np.ravel(quads).tolist())
    stage.GetRootLayer().Save()
    return np.array(corners, float)


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_a_stage_of_another_program_is_read(tmp_path, up, orientation):
    path = tmp_path / "body.usda"
    corners = written_stage(path, up=up, orientation=orientation)
    cage = Cage.load(path)
    world = corners + [0, 3, 0]
    turned = world[:, [0, 2, 1]] * [1, -1, 1] if up == "Y" else world
    np.testing.assert_allclose(cage.vertices, turned, atol=1e-12)
    cage.require_usable()
    assert cage.volume == pytest.approx(8.0)
    assert np.array_equal(Cage.load(path, object="Body").vertices, cage.vertices)
    refused(lambda: Cage.load(path, object="Head"), match="only Body")
    file = PoseFile.load(path)
    assert len(file) == 5 and file.fps == 25 and file.times["frame 5"] == pytest.approx(4 / 25)
    angle = np.radians(45.0)
    around_y = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    moved = corners @ around_y.T + [0, 3, 0]
    expected = moved[:, [0, 2, 1]] * [1, -1, 1] if up == "Y" else moved
    np.testing.assert_allclose(file["frame 4"].vertices, expected, atol=1e-6)


@pytest.mark.parametrize("damage", [b"", b"PXR-USDC", b"#usda 1.0\ndef Mesh {", b"no stage"])
def test_a_damaged_stage_is_refused_in_one_line(tmp_path, damage):
    pytest.importorskip("pxr")
    path = tmp_path / "bad.usd"
    path.write_bytes(damage)
    refused(lambda: Cage.load(path), match="bad.usd")


@pytest.mark.parametrize(
    ("old", "new"),
    [("[4, 4, 4, 4, 4, 4]", "[4, 4, 4]"), ("[0, 1, 3, 2,", "[0, 1, 3, 99,"), ("[(0, 0, 0),", "[(0, 0, inf),")],
)
def test_a_stage_whose_parts_do_not_fit_is_refused(tmp_path, old, new):
    path = tmp_path / "bad.usda"
    written_stage(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refused(lambda: Cage.load(path), match="bad.usda")


def test_without_its_library_usd_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    for attempt in (lambda: BOX.save(tmp_path / "b.usdc"), lambda: Cage.load(tmp_path / "a.usda")):
        refused(attempt, match=r"pip install .*\[usd\]", error=ImportError)
    assert not (tmp_path / "b.usdc").exists()
