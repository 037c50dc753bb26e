"""A scene of another size, or far from the origin, gives the same result: nothing is measured in the world's units."""

import dataclasses
import functools

import numpy as np
import pytest
from scene_writers import brick_pictures, write_nsvf

from warpcage import Cage, Camera, Deformer, Scene, SplatField, VoxelField, bake, fit, load_scene, to_splats, turntable
from warpcage.core import resolve_device
from warpcage.fitting import object_bounds
from warpcage.scene import find_box
from warpcage.studio.cli import main
from warpcage.studio.films.render import Look

FAR = np.array([1e4, -2e4, 3e4])
WORLDS = {
    "1024 times": (1024.0, 0 * FAR),
    "1000 times": (1000.0, 0 * FAR),
    "a thousandth": (1e-3, 0 * FAR),
    "far": (1.0, FAR),
    "1000 times and far": (1000.0, 1000.0 * FAR),
    "UTM": (1.0, np.array([500000.0, 5400000.0, 300.0])),
}


@pytest.fixture(scope="module")
def pictures():
    return brick_pictures(16, width=28, height=28)


def placed(cameras, scale, shift):
    moved = []
    for camera in cameras:
        pose = camera.camera_to_world.copy()
        pose[:3, 3] = pose[:3, 3] * scale + shift
        moved.append(dataclasses.replace(camera, camera_to_world=pose))
    return moved


def make_scene(pictures, scale, shift, alpha):
    images, alphas = pictures.over((1.0, 1.0, 1.0))
    return Scene(images, alphas if alpha else None, placed(pictures.cameras, scale, shift))


def short_fit(scene):
    """A field after a few steps. Without alphas nothing is pruned: matter is still fog then, and which voxels reach a
    threshold is up to rounding, on a GPU from run to run."""
    kept = {} if scene.alphas is not None else {"prune_weight": 0.0, "keep_weight": 0.0}
    return fit(scene, resolution=24, epochs=2, progress=False, **kept)


@pytest.fixture(scope="module")
def worlds(pictures):
    """The field of the scene in a world, None where it is, with and without alphas; each is made once."""

    @functools.cache
    def fitted(world, alpha):
        scale, shift = WORLDS[world] if world else (1.0, 0 * FAR)
        return short_fit(make_scene(pictures, scale, shift, alpha))

    return lambda world=None, alpha=True: fitted(world, alpha)


@pytest.mark.parametrize(
    "world, alpha", [*((world, True) for world in WORLDS), ("1024 times", False), ("1000 times and far", False)]
)
def test_a_fit_is_the_same_anywhere(pictures, worlds, world, alpha):
    scale, shift = WORLDS[world]
    scene = make_scene(pictures, scale, shift, alpha)
    field, expected = worlds(world, alpha), worlds(alpha=alpha)
    np.testing.assert_allclose((field.bounds - shift) / scale, expected.bounds, atol=1e-9)
    assert field.resolution == expected.resolution
    for camera, here in list(zip(scene.cameras, pictures.cameras, strict=True))[::5]:
        frame, plain = field.render(camera), expected.render(here)
        # other factors round otherwise, and so do the sums of a GPU from run to run; optimising magnifies that
        tolerance = 1e-6 if world == "1024 times" and field.device.is_cpu else 3e-3
        assert np.abs(frame.rgb - plain.rgb).mean() < tolerance
        assert np.abs(frame.alpha - plain.alpha).mean() < tolerance
        seen = plain.alpha > 0.5
        assert np.median(np.abs(frame.depth[seen] / scale / plain.depth[seen] - 1)) < (1e-3 if alpha else tolerance)
    assert 0.02 < seen.mean() < 0.98


@pytest.mark.parametrize("world", ["1000 times", "far", "UTM"])
def test_an_edit_is_the_same_anywhere(pictures, worlds, world):
    scale, shift = WORLDS[world]
    field = worlds(world)
    rest = Cage.box(*worlds().bounds, segments=2)
    posed = rest.bend(30, axis="x", towards="z")
    frames = []
    for each, k, offset in ((worlds(), 1.0, 0 * FAR), (field, scale, shift)):
        deformer = Deformer(each, Cage(rest.vertices * k + offset, rest.faces), coordinates="mean_value", resolution=24)
        deformer.pose(Cage(posed.vertices * k + offset, posed.faces))
        frames.append(deformer.render(placed(pictures.cameras[:1], k, offset)[0]).rgb)
    assert np.abs(frames[1] - frames[0]).mean() < 2e-3
    assert np.abs(frames[0] - worlds().render(pictures.cameras[0]).rgb).mean() > 0.01  # it is an edit


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("layout", ["around", "parallel"])
def test_bounds_follow_the_cameras(pictures, world, layout):
    scale, shift = WORLDS[world]
    cameras = pictures.cameras
    if layout == "parallel":
        cameras = [
            Camera(40, 40, 14, 14, 28, 28, np.block([[np.eye(3), np.array([[x], [y], [0.0]])], [0, 0, 0, 1.0]]))
            for x in (0.0, 0.5, 1.0)
            for y in (0.0, 0.3)
        ]
    box, moved = (find_box(placed(cameras, *place)).bounds for place in ((1.0, 0 * FAR), (scale, shift)))
    np.testing.assert_allclose((moved - shift) / scale, box, atol=1e-8)
    if layout == "parallel":
        assert box[0, 2] > 0.0  # ahead


def test_bounds_of_the_data_come_first(tmp_path, pictures):
    write_nsvf(tmp_path / "nsvf", pictures, "0" * 16, bbox=(-1.5, -1.5, -1.4, 1.5, 1.5, 1.5))
    scene = load_scene(tmp_path / "nsvf")
    device = resolve_device(None)
    opaque = dataclasses.replace(scene, alphas=None)
    np.testing.assert_array_equal(object_bounds(opaque, device), [[-1.5, -1.5, -1.4], [1.5, 1.5, 1.5]])
    hull = object_bounds(scene, device)  # shrunk to the silhouettes
    assert (hull[1] - hull[0] < 2.9).all()


def test_up_is_how_the_cameras_were_held(pictures):
    scene = make_scene(pictures, 1000.0, FAR, False)
    held = np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])  # as spiral_cameras does
    np.testing.assert_allclose(scene.up, held, atol=1e-6)
    turn = Camera.look_at([0, 0, 0], [1, 1, 1]).camera_to_world
    turned = Scene(np.zeros((16, 28, 28, 3)), None, [camera.moved(turn) for camera in pictures.cameras])
    np.testing.assert_allclose(turned.up, turn[:3, :3] @ held, atol=1e-6)
    alone = Scene(np.zeros((1, 28, 28, 3)), None, pictures.cameras[:1])
    np.testing.assert_allclose(alone.up, -pictures.cameras[0].rotation[:, 1], atol=1e-9)
    level = Scene(np.zeros((8, 28, 28, 3)), None, turntable([1, 2, 3], 4.0, 20.0, 8, width=28, height=28))
    np.testing.assert_allclose(level.up, [0, 0, 1], atol=1e-12)


def test_a_field_keeps_what_is_up(pictures, worlds, tmp_path, monkeypatch):
    np.testing.assert_allclose(worlds().up, np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0]), atol=1e-6)
    worlds().save(tmp_path / "field.npz")
    np.testing.assert_allclose(VoxelField.load(tmp_path / "field.npz").up, worlds().up, atol=1e-12)
    from warpcage import cli

    seen = []
    monkeypatch.setattr(Look, "render", lambda self, scene, camera: seen.append(camera) or exit_early())
    for arguments, up in (([], worlds().up), (["--up", "0", "1", "0"], np.array([0.0, 1.0, 0.0]))):
        assert cli.main(["render", str(tmp_path / "field.npz"), "-o", str(tmp_path / "new.png"), *arguments]) == 2
        camera = seen.pop()
        assert abs(camera.rotation[:, 0] @ up) < 1e-6 and -camera.rotation[:, 1] @ up > 0.5


def exit_early():
    raise ValueError("the camera is all that is asked for")


# What leaves the program far from the origin: coordinates of UTM, in metres, where float32 resolves half a metre

UTM = WORLDS["UTM"][1]


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb"])
@pytest.mark.parametrize("colors", ["--colors", "--no-colors"])
def test_meshes_are_written_where_they_are(tmp_path, worlds, ending, colors):
    plain, far = worlds(), worlds("UTM")
    for name, field in (("plain", plain), ("far", far)):
        field.save(tmp_path / f"{name}.npz")
        arguments = ["mesh", f"{tmp_path}/{name}.npz", "-o", f"{tmp_path}/{name}{ending}", colors]
        assert main(arguments) == 0
    one, two = (Cage.load(tmp_path / f"{name}{ending}") for name in ("plain", "far"))
    size = one.size
    np.testing.assert_allclose(two.bounds - UTM, one.bounds, atol=2e-2 * size)  # two fits are not the same to the bit
    steps = np.diff(np.unique(np.round(two.vertices[:, 1] - UTM[1], 6)))
    assert len(steps) > 20 and np.median(steps) < 0.02 * size  # float32 has two steps there
    np.testing.assert_allclose(two.vertices.mean(axis=0) - UTM, one.vertices.mean(axis=0), atol=2e-2 * size)


def test_stl_says_that_it_rounds(tmp_path, worlds, capsys):
    worlds("UTM").save(tmp_path / "far.npz")
    assert main(["mesh", f"{tmp_path}/far.npz", "-o", f"{tmp_path}/far.stl"]) == 0
    assert "STL holds float32, which rounds places so far from the origin to 0.5 units" in capsys.readouterr().err


def some_splats(shift):
    rng = np.random.default_rng(4)
    centers = rng.normal(size=(60, 3)) * 0.4 + shift
    values = (np.full((60, 3), -2.5), rng.normal(size=(60, 4)), rng.normal(size=60), rng.normal(size=(60, 1, 3)))
    return SplatField(centers, *values)


def test_splats_are_the_same_far_away(tmp_path):
    """Rendered, posed, baked, saved as .ply and read again: within float32 of the size of the scene."""
    camera = Camera.look_at((3, 1, 1), (0, 0, 0), width=48, height=40)
    rest = Cage.box((-2, -2, -2), (2, 2, 2), segments=2)
    found = []
    for shift in (0 * UTM, UTM):
        field, here = some_splats(shift), placed([camera], 1.0, shift)[0]
        field.save(tmp_path / "a.ply")
        again = SplatField.load(tmp_path / "a.ply")
        cage = rest.translate(shift)
        posed = Deformer(field, cage, coordinates="mean_value").pose(rest.twist(40, axis="z").translate(shift))
        baked = bake(posed)
        baked.save(tmp_path / "b.ply")
        read = SplatField.load(tmp_path / "b.ply").contents.centers
        frames = [each.render(here).rgb for each in (field, again, posed, baked)]
        found.append((frames, again.contents.centers - shift, read - shift))
    for one, two in zip(*(each[0] for each in found), strict=True):
        assert np.abs(one - two).max() < 1e-3
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-6)
    np.testing.assert_allclose(found[1][2], found[0][2], atol=1e-5)


@pytest.mark.parametrize("ending", [".splat", ".compressed.ply"])
def test_formats_of_float32_say_that_they_round(tmp_path, ending):
    some_splats(0 * UTM).save(tmp_path / f"near{ending}")
    with pytest.warns(UserWarning, match="to 0.5 units"):
        some_splats(UTM).save(tmp_path / f"far{ending}")


def test_splats_of_a_voxel_field_keep_their_places(tmp_path, worlds, pictures):
    field = worlds("UTM")
    to_splats(field).save(tmp_path / "a.ply")
    splats, camera = SplatField.load(tmp_path / "a.ply"), placed(pictures.cameras[:1], 1.0, UTM)[0]
    assert splats.contents.centers.dtype == np.float64
    near = to_splats(worlds()).render(pictures.cameras[0])
    assert np.abs(splats.render(camera).alpha - near.alpha).mean() < 5e-3 < 0.1 < near.alpha.mean()


def test_a_scene_is_recentred_by_a_motion_that_the_field_keeps(pictures):
    """`orient` of load_scene, `Scene.moved`: the inverse leads back to the coordinates of the files."""
    motion = np.eye(4)
    motion[:3, 3] = -UTM
    scene = make_scene(pictures, 1.0, UTM, True).moved(motion)
    np.testing.assert_allclose(scene.cameras[3].center, pictures.cameras[3].center, atol=1e-8)
    field = short_fit(scene)
    np.testing.assert_allclose(np.linalg.inv(field.straightening)[:3, 3], UTM)
