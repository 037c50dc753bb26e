"""Fits of nested cubes to a room of the project's own: files, edits, checkpoints, memory, and the command line."""

import numpy as np
import pytest
from scenes import room_cameras, room_scene, write_room

import warpcage
from warpcage import FieldOptimizer, mean_psnr
from warpcage.cli import main
from warpcage.field import ShellField
from warpcage.fitting import load_progress, save_progress

SMALL = {"resolution": 32, "levels": 2, "epochs": 6, "batch_rays": 1024, "background": "shells", "shell_divisions": 2}


@pytest.fixture(scope="module")
def room():
    """The room's whole pictures, and the field fitted to them."""
    scene = room_scene(24, 32, masks=False)
    return scene, warpcage.fit(scene, progress=False, **SMALL)


def test_a_room_is_seen_from_new_places(room):
    scene, field = room
    model = field.background_model
    assert isinstance(model, ShellField) and model.voxel_count > 100
    assert set(model.layout.places.numpy()[:, 3]) > {1}  # bricks of several sizes
    test = room_scene(5, 32, masks="split", turn=0.13)
    assert mean_psnr(warpcage.evaluate(field, test)) > 26
    frame, alone = field.render(scene.cameras[0]), field.render(scene.cameras[0], background="black")
    assert (frame.alpha <= alone.alpha + 1e-6).all()  # what is before the box can only hide it
    np.testing.assert_array_equal(frame.depth, alone.depth)


@pytest.mark.parametrize("format", ["warpcage", "compact"])
def test_nested_cubes_are_saved_and_loaded(room, tmp_path, format):
    scene, field = room
    field.save(tmp_path / "f.npz", format=format)
    assert np.load(tmp_path / "f.npz")["version"] == 5
    again = warpcage.VoxelField.load(tmp_path / "f.npz")
    model, loaded = field.background_model, again.background_model
    np.testing.assert_array_equal(loaded.layout.links.numpy(), model.layout.links.numpy())
    np.testing.assert_array_equal(loaded.center, model.center)
    np.testing.assert_allclose(loaded.sky, model.sky, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(loaded.values[:, :3], model.values[:, :3], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(loaded.slopes, model.slopes, atol=0.5 / 127 + 1e-6)
    assert warpcage.psnr(again.render(scene.cameras[0]).rgb, field.render(scene.cameras[0]).rgb) > 35
    again.save(tmp_path / "g.npz", format=format)
    np.testing.assert_array_equal(warpcage.VoxelField.load(tmp_path / "g.npz").background_model.values, loaded.values)
    scaled = warpcage.VoxelField.load(tmp_path / "f.npz", scene_scale=0.5).background_model
    np.testing.assert_array_equal(scaled.half, 2 * model.half)


@pytest.mark.parametrize(
    "change, word",
    [
        ({"shells_rgba": np.zeros((3, 4), np.uint8)}, "shells_rgba"),
        ({"shells_slopes": None}, "shells_slopes"),
        ({"shells_nodes": np.zeros(3, np.uint8)}, "shells_nodes"),
        ({"shells_side": np.array(10**6)}, "bricks along a side"),
        ({"shells_half": np.array([1.0, -1.0, 1.0])}, "half sides"),
        ({"shells_center": np.array([0, np.inf, 0])}, "center"),
        ({"shells_sky": None}, "shells_sky"),
    ],
)
def test_damaged_nested_cubes_are_named(room, tmp_path, change, word):
    room[1].save(tmp_path / "f.npz")
    contents = dict(np.load(tmp_path / "f.npz")) | change
    np.savez(tmp_path / "d.npz", **{name: array for name, array in contents.items() if array is not None})
    with pytest.raises(ValueError, match=word) as raised:
        warpcage.VoxelField.load(tmp_path / "d.npz")
    assert "d.npz" in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("at, number", [((0, 1), -1), ((0, 0), 500), ((0, 3), 0), ((0, 3), 99), ((0, slice(None)), 1)])
def test_bricks_in_impossible_places_are_named(room, tmp_path, at, number):
    """Outside the table, of no size, or where another brick is."""
    room[1].save(tmp_path / "f.npz")
    contents = dict(np.load(tmp_path / "f.npz"))
    places = contents["shells_places"]
    places[at] = places[1] if isinstance(at[1], slice) else number
    np.savez(tmp_path / "d.npz", **contents)
    with pytest.raises(ValueError, match="shells_places"):
        warpcage.VoxelField.load(tmp_path / "d.npz")


CAGE = warpcage.Cage.box([-1.0, -0.8, -0.9], [1.3, 0.8, 1.1])


def test_the_room_stays_while_the_object_moves(room, device):
    """A moved object is before what is behind it, and what was behind shows where it was, marked."""
    field = room[1].to(device)
    camera = room_cameras(1, 48, 0.3)[0]
    deformer = warpcage.Deformer(field, CAGE, resolution=24).pose(CAGE.scale(0.35).translate([0.0, 0.0, 1.35]))
    frame, alone = deformer.render(camera), deformer.render(camera, background="black")
    cleared = (field.render(camera).alpha > 0.9) & (alone.alpha < 1e-4)
    assert cleared.sum() > 20 and frame.reveal[cleared].min() > 0.3
    origins, directions = camera.rays()
    behind = field.background_model.sample(origins[cleared], directions[cleared])
    np.testing.assert_allclose(frame.rgb[cleared], behind, atol=5e-3)
    assert warpcage.bake(deformer, resolution=32).background_model is field.background_model


def test_whole_pictures_are_needed():
    with pytest.raises(ValueError, match="whole pictures"):
        warpcage.fit(room_scene(3, 16, masks="split"), background="shells", progress=False)


def test_nested_cubes_keep_within_the_memory_given():
    """The fit refines where it can afford to, bricks that earn most first."""
    scene, held = room_scene(6, 16, masks=False), []
    most = 40e6
    optimizer = FieldOptimizer(scene, max_memory=most, **(SMALL | {"outer_resolution": 128}))
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
        held.append(optimizer.background.held_bytes)
    sizes = optimizer.background.outer.layout.places.numpy()[:, 3]
    assert max(held) < 0.4 * most and sizes.max() > 1


def test_a_fit_goes_on_from_its_checkpoint(tmp_path):
    scene = room_scene(6, 16, masks=False)
    options = SMALL | {"resolution": 16}
    through, stopped, resumed = (FieldOptimizer(scene, **options) for _ in range(3))
    for step in range(through.total_steps):
        through.step()
        if step < through.total_steps * 2 // 3:
            stopped.step()
    save_progress(stopped, tmp_path / "c.npz")
    load_progress(resumed, tmp_path / "c.npz")
    assert resumed.level == 1
    for name in ("values", "slopes"):
        np.testing.assert_array_equal(getattr(resumed.background.outer, name), getattr(stopped.background.outer, name))
    while resumed.step_count < resumed.total_steps:
        resumed.step()
    psnrs = [mean_psnr(warpcage.evaluate(optimizer.finish(), scene)) for optimizer in (through, resumed)]
    assert abs(psnrs[0] - psnrs[1]) < 0.3  # sums of atomics on a GPU
    contents = dict(np.load(tmp_path / "c.npz"))
    for change in (
        {"shells_values": np.zeros((2, 8))},
        {"shells_nodes": np.zeros(2, np.uint8)},
        {"shells_side": np.array(10**6)},
        {"shells_places": np.zeros_like(contents["shells_places"])},
        {"shells_moments": np.full_like(contents["shells_moments"], -1)},
        {"shells_earned": np.full_like(contents["shells_earned"], np.nan)},
    ):
        np.savez(tmp_path / "d.npz", **(contents | change))
        with pytest.raises(ValueError, match="damaged fit checkpoint"):
            load_progress(FieldOptimizer(scene, **options), tmp_path / "d.npz")


def test_the_way_on_the_command_line(tmp_path, capsys):
    folder, field = write_room(tmp_path / "dtu", 17, 24), tmp_path / "room.npz"
    words = ["--resolution", "24", "--epochs", "3", "--quiet", "--background", "shells"]
    assert main(["fit", str(folder), "-o", str(field), "--no-masks", *words]) == 0
    assert "voxels around it in 6 nested cubes" in capsys.readouterr().out
    assert main(["info", str(field)]) == 0
    assert "in 6 nested cubes of up to" in capsys.readouterr().out
    CAGE.save(tmp_path / "cage.obj")
    view = ["--camera", f"{folder}:test:1", "--cage", str(tmp_path / "cage.obj"), "--posed", "scale:0.5"]
    assert main(["render", str(field), "-o", str(tmp_path / "r.png"), *view, "--fill"]) == 0
