"""Fits of outer fields to a room of the project's own: files, edits, checkpoints, memory, and the command line."""

import numpy as np
import pytest
from fit_oracles import finished
from messages import MESSAGES
from refusals import refused
from scenes import room_cameras, room_scene, write_room

import warpcage
from warpcage import FieldOptimizer, Scene, mean_psnr
from warpcage.field import OuterField
from warpcage.fitting import load_progress, save_progress
from warpcage.fitting import optimizer as optimizer_module
from warpcage.studio.cli import main
from warpcage.view import read_image

SMALL = {"resolution": 32, "levels": 2, "epochs": 6, "batch_rays": 1024, "background": "outer"}


@pytest.fixture(scope="module")
def room():
    """The room's whole pictures, and the field fitted to them."""
    scene = room_scene(24, 32, masks=False)
    return scene, warpcage.fit(scene, progress=False, **SMALL)


def test_a_room_is_seen_from_new_places(room):
    scene, field = room
    assert isinstance(field.background_model, OuterField) and field.background_model.voxel_count > 100
    test = room_scene(5, 32, masks="split", turn=0.13)
    assert mean_psnr(warpcage.evaluate(field, test)) > 26
    renders, outside = np.stack([field.render(camera).rgb for camera in test.cameras]), test.alphas == 0
    assert warpcage.psnr(renders[outside], test.whole[outside]) > 28.5
    frame, alone = field.render(scene.cameras[0]), field.render(scene.cameras[0], background="black")
    assert (frame.alpha <= alone.alpha + 1e-6).all()  # what is before the box can only hide it
    np.testing.assert_array_equal(frame.depth, alone.depth)


@pytest.mark.parametrize("format", ["warpcage", "compact"])
def test_outer_fields_are_saved_and_loaded(room, tmp_path, format):
    scene, field = room
    field.save(tmp_path / "f.npz", format=format)
    assert np.load(tmp_path / "f.npz")["version"] == 4
    again = warpcage.VoxelField.load(tmp_path / "f.npz")
    model, loaded = field.background_model, again.background_model
    np.testing.assert_array_equal(loaded.contents().links, model.contents().links)
    np.testing.assert_array_equal(loaded.center, model.center)
    np.testing.assert_allclose(loaded.sky, model.sky, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(loaded.values[:, :3], model.values[:, :3], atol=0.5 / 255 + 1e-6)
    assert warpcage.psnr(again.render(scene.cameras[0]).rgb, field.render(scene.cameras[0]).rgb) > 35
    again.save(tmp_path / "g.npz", format=format)
    np.testing.assert_array_equal(warpcage.VoxelField.load(tmp_path / "g.npz").background_model.values, loaded.values)
    scaled = warpcage.VoxelField.load(tmp_path / "f.npz", scene_scale=0.5).background_model
    np.testing.assert_array_equal(scaled.half, 2 * model.half)
    with pytest.warns(UserWarning, match="outer field"):
        field.save(tmp_path / "p.npz", format="svox2")


@pytest.fixture(scope="module")
def scene():
    return room_scene(6, 16, masks=False)


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
    baked = warpcage.bake(deformer, resolution=32)
    assert baked.background_model is field.background_model


def test_whole_pictures_are_needed():
    split = room_scene(3, 16, masks="split")
    refused(lambda: warpcage.fit(split, background="outer", progress=False), match="whole pictures")


def test_an_outer_field_keeps_within_the_memory_given(scene):
    most = 24e6
    optimizer = FieldOptimizer(scene, max_memory=most, **(SMALL | {"outer_resolution": 128}))
    held = []
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
        held.append(optimizer.background.held_bytes)
    assert 32 < optimizer.background.outer.side < 128 and max(held) < 0.4 * most
    refused(lambda: FieldOptimizer(scene, outer_resolution=2), match="outer_resolution")


def test_a_checkpoint_with_layers_is_told_of(scene, tmp_path, monkeypatch):
    """Of whole pictures, by a version whose default they were: its options have the same names."""
    options = SMALL | {"resolution": 16, "background": "auto"}
    with monkeypatch.context() as before:
        before.setattr(optimizer_module, "chosen_background", lambda *_: (False, "layers"))
        layered = FieldOptimizer(scene, **options)
    layered.step()
    save_progress(layered, tmp_path / "c.npz")
    with pytest.raises(ValueError, match=MESSAGES["fitting.checkpoint_layers"]):
        load_progress(FieldOptimizer(scene, **options), tmp_path / "c.npz")


def test_a_fit_goes_on_from_its_checkpoint(scene, tmp_path):
    """With what is around its box, and the numbers of views that show voxels."""
    options = SMALL | {"resolution": 16, "variation_views": 9, "variation_outer_views": 9}
    through, resumed = (FieldOptimizer(scene, **options) for _ in range(2))
    while through.step_count < through.total_steps * 2 // 3:
        through.step()
    save_progress(through, tmp_path / "c.npz")
    load_progress(resumed, tmp_path / "c.npz")
    assert resumed.level == 1
    np.testing.assert_array_equal(resumed.background.outer.values, through.background.outer.values)
    for part in ("current", "background"):
        counts, expected = (getattr(fit, part).views.counts.numpy() for fit in (resumed, through))
        assert counts.any()
        np.testing.assert_array_equal(counts, expected)
    psnrs = [mean_psnr(warpcage.evaluate(finished(fit).finish(), scene)) for fit in (through, resumed)]
    assert abs(psnrs[0] - psnrs[1]) < 0.3  # sums of atomics on a GPU
    contents = dict(np.load(tmp_path / "c.npz"))
    for change in (
        {"outer_values": np.zeros((2, 4))},
        {"outer_occupancy": np.zeros(2, np.uint8)},
        {"outer_sides": np.array([4, 400])},
        {"outer_moments": np.full_like(contents["outer_moments"], -1)},
        {"views": contents["views"][1:]},
        {"outer_views": contents["outer_views"][1:]},
    ):
        np.savez(tmp_path / "d.npz", **(contents | change))
        with pytest.raises(ValueError, match="damaged fit checkpoint"):
            load_progress(FieldOptimizer(scene, **options), tmp_path / "d.npz")


def test_a_fit_goes_on_where_the_sky_alone_is_left(device, tmp_path):
    """Nothing around the box has any density: its voxels go with the first level."""
    scene, options = room_scene(8, 16, masks=False), SMALL | {"resolution": 16, "device": device}
    optimizer, resumed = (FieldOptimizer(scene, **options) for _ in range(2))
    while not optimizer.level_done:
        optimizer.step()
    optimizer.background.outer.grid.values.zero_()
    optimizer.step()
    assert optimizer.level == 1 and optimizer.background.outer.voxel_count == 0
    save_progress(optimizer, tmp_path / "c.npz")
    load_progress(resumed, tmp_path / "c.npz")
    field = finished(resumed).finish()
    field.save(tmp_path / "field.npz")
    again = warpcage.VoxelField.load(tmp_path / "field.npz", device=device)
    assert again.background_model.voxel_count == 0 and mean_psnr(warpcage.evaluate(again, scene)) > 15


def test_the_way_on_the_command_line(tmp_path, capsys):
    folder, field = write_room(tmp_path / "dtu", 17, 24), tmp_path / "room.npz"
    arguments = ["--resolution", "24", "--epochs", "3", "--quiet"]
    assert main(["fit", str(folder), "-o", str(field), "--no-masks", *arguments]) == 0  # by itself for whole pictures
    assert "voxels around it in 24^3" in capsys.readouterr().out
    assert main(["info", str(field)]) == 0
    assert "voxels in 24^3 of contracted space" in capsys.readouterr().out
    CAGE.save(tmp_path / "cage.obj")
    view = ["--camera", f"{folder}:test:1", "--cage", str(tmp_path / "cage.obj"), "--posed", "scale:0.5"]
    assert main(["render", str(field), "-o", str(tmp_path / "r.png"), *view, "--fill"]) == 0
    baked, black = tmp_path / "baked.npz", ["--background", "black"]
    pose = view[2:] + ["--resolution", "16"]
    assert main(["bake", str(field), "-o", str(baked), *pose]) == 0
    assert warpcage.VoxelField.load(baked).background_model.voxel_count > 100
    for name, more in (("b.png", []), ("black.png", black)):
        assert main(["render", str(baked), "-o", str(tmp_path / name), *view[:2], *more]) == 0
    seen, dark = (read_image(tmp_path / name)[..., :3] for name in ("b.png", "black.png"))
    assert (dark[0] == 0).all() and seen[0].min() > 0.02  # the walls are there
    assert main(["fit", str(folder), "-o", str(tmp_path / "cut.npz"), "--background", "outer", *arguments]) == 2
    assert "whole pictures" in capsys.readouterr().err


def repeated(scene, times):
    """The scene with each of its views so many times."""
    return Scene(np.repeat(scene.images, times, axis=0), None, [each for each in scene.cameras for _ in range(times)])


def test_what_is_around_is_finer_where_many_rays_go(scene):
    """By the root of the rays, as far as half as fine again, and never where a side is given."""
    options = {"resolution": 24, "levels": 2, "background": "outer"}
    sides = [FieldOptimizer(repeated(scene, n), **options).background.sides[-1] for n in (1, 100, 150, 300)]
    assert sides[0] == 24 and sides[-1] == 36
    rays = [6 * n * (2 * scene.cameras[0].fx / 24) ** 2 for n in (100, 150)]
    for side, seen in zip(sides[1:3], rays, strict=True):
        assert abs(side - 24 * np.clip(np.sqrt(seen / 1200), 1, 1.5)) <= 2
    assert FieldOptimizer(repeated(scene, 300), outer_resolution=20, **options).background.sides[-1] == 20


def test_what_is_finer_around_begins_faster(scene):
    """A step has fewer rays for each voxel; by the square of the ratio of sides, twice as fast at most, and not at
    the end."""
    for side, factor in ((20, 1.0), (24, 1.0), (30, 1.5625), (36, 2.0)):
        fit = FieldOptimizer(scene, resolution=24, levels=2, background="outer", outer_resolution=side)
        schedule, options = fit.schedule, fit.options
        first = schedule.rates()
        schedule.step_count = schedule.total_steps - 1
        last = schedule.rates()
        rates = [first.outer, first.outer_density, last.outer, last.outer_density, first.density]
        expected = [factor * options.rate_outer, factor * options.rate_outer_density, options.rate_outer_end]
        np.testing.assert_allclose(rates, [*expected, options.rate_outer_density_end, options.rate_density], rtol=1e-6)


def test_rays_of_a_fit_are_limited_unless_passes_are_asked_for(scene):
    options = {"resolution": 16, "batch_rays": 64, "least_steps": 0, "background": "outer"}
    pixels = 6 * 16 * 16

    def rays(**given):
        optimizer = FieldOptimizer(scene, **(options | given))
        return optimizer.total_steps * optimizer.batches.batch_rays

    assert rays(quality="standard") == pytest.approx(11 * pixels, rel=0.05)
    assert rays(most_rays=2000) == pytest.approx(2000, rel=0.05)
    assert rays(most_rays=2e6) == pytest.approx(11 * pixels, rel=0.05)
    assert rays(epochs=20) == pytest.approx(20 * pixels, rel=0.05)


def test_a_new_level_begins_with_what_can_be_seen(device):
    """Voxels of it have the weight by which a level is pruned, or are beside one that has; by the coarser ones half
    would."""
    scene = room_scene(8, 24, masks=False)
    optimizer = FieldOptimizer(scene, device=device, **SMALL)
    while optimizer.level == 0:
        optimizer.step()
    weights = optimizer.current.measure_weights(optimizer.batches.picture_rays).numpy()
    kept = np.zeros(optimizer.field.resolution)
    kept.flat[optimizer.current.nodes.numpy()] = weights
    near = np.max([np.roll(np.pad(kept, 1), shift, axis=(0, 1, 2)) for shift in np.ndindex(3, 3, 3)], axis=0)
    near = near[2:, 2:, 2:]  # the largest of the 27 nodes around each, shifted by one
    least = 0.13 / max(optimizer.field.resolution)
    beside = near.flat[optimizer.current.nodes.numpy()]
    assert (beside > 0.2 * least).mean() > 0.85  # one step has changed the weights since
