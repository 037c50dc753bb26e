"""Background layers: against a plain NumPy version, finite differences, and a scene of the project's own."""

import dataclasses
import functools
import json

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fit_oracles import photometric_gradient, training_rays
from messages import MESSAGES
from refusals import refused
from scenes import room_cameras, room_scene, write_room

import warpcage
from warpcage import FieldOptimizer, mean_psnr
from warpcage.field import LayeredBackground, surface_node_count
from warpcage.fitting import Silhouettes, chosen_background, keep_seen, load_progress, save_progress
from warpcage.kernels.fitting import background_loss
from warpcage.studio.cli import main
from warpcage.view import read_image


def test_colors_match_numpy(device):
    background, values = oracle.random_background(device)
    origins, directions = oracle.rays_of(300)
    rays = list(zip(origins, directions, strict=True))
    expected = [oracle.ray_color(background, values, *ray) for ray in rays]
    np.testing.assert_allclose(background.sample(origins, directions), expected, atol=2e-5)
    assert any(place is None for ray in rays for place in oracle.layer_points(background, *ray))  # some pass a cube by
    refused(lambda: background.sample(origins, directions[1:]), match=MESSAGES["field.directions"])


def test_faces_join_without_a_seam(device):
    background, _ = oracle.random_background(device, side=5)
    random = np.random.default_rng(1)
    edge = random.uniform(-1, 1, (200, 3))
    edge[:, 0] = edge[:, 1]  # towards the edges between the faces across x and y
    edge[:, 2] *= 0.9
    tilt = 1e-5 * np.array([1.0, -1.0, 0.0])
    origin = np.tile(background.center, (200, 1))
    one, other = (background.sample(origin, edge + sign * tilt) for sign in (1, -1))
    np.testing.assert_allclose(one, other, atol=2e-3)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"half": 0.0}, "half side"),
        ({"side": 1}, "2 cells"),
        ({"values": np.zeros((1, 26, 4))}, "layers"),
        ({"values": np.zeros((3, 25, 4))}, "26"),
        ({"values": np.full((3, 26, 4), np.nan)}, "finite"),
        ({"center": (0, np.inf, 0)}, "center"),
    ],
)
def test_bad_backgrounds(change, message):
    given = {"center": (0, 0, 0), "half": 1.0, "side": 2, "values": np.zeros((3, 26, 4))} | change
    refused(lambda: LayeredBackground(**given), match=message)


def test_gradients_match_finite_differences(device):
    """Of the whole loss, the field's march included, by the layers' values; and the field's own with layers behind."""
    field, density, sh = oracle.random_field(
        device, resolution=(4, 4, 4), keep=0.5, density_scale=0.5, bounds=((-1,) * 3, (1,) * 3), numbers=(24,)
    )
    background, values = oracle.random_background(device, side=3, layers=4, center=(0, 0, 0), half=1.0)
    cameras = [
        warpcage.Camera.look_at(eye, [0, 0, 0], fov_degrees=70, width=8, height=6)
        for eye in ([3.0, 0.4, 0.5], [-0.3, 0.5, 0.2])
    ]
    random = np.random.default_rng(0)
    images = random.random((2, 6, 8, 3)).astype(np.float16).astype(np.float64)
    rays = training_rays(cameras, images, np.ones((2, 6, 8)), field, device)
    behind, grad_behind = (wp.zeros(96, dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(
        background_loss.gather_background, dim=96, inputs=[0, background.layers, rays], outputs=[behind], device=device
    )
    scale = 1 / (3 * 96)
    gradients, _ = photometric_gradient(
        field,
        rays,
        96,
        scale=scale,
        by_warps=not wp.get_device(device).is_cpu,
        own_background=behind,
        grad_background=grad_behind,
    )
    grad_density = gradients[:, 24]
    grad = wp.zeros(background.layers.values.shape, dtype=wp.vec4, device=device)
    wp.launch(
        background_loss.accumulate_background_gradient,
        dim=96,
        device=device,
        inputs=[0, background.layers, rays, grad_behind],
        outputs=[grad],
    )

    sight = [(o, d) for camera in cameras for o, d in zip(*(x.reshape(-1, 3) for x in camera.rays()), strict=True)]

    def around(values):
        return np.array([oracle.ray_color(background, values, *ray) for ray in sight])

    def before(density):
        """What rays see of the field, before black, and how much of what is behind it."""
        seen = [oracle.render_ray(field, density, sh, *ray, field.step, np.zeros(3), length=6.0) for ray in sight]
        return np.array([rgb for rgb, _, _ in seen]), np.array([[1 - opacity] for _, opacity, _ in seen])

    def slope(changed, at, which):
        ends = []
        for sign in (1, -1):
            moved = changed.copy()
            moved[at] += sign * 1e-4
            (rgb, left), far = (before(moved), at_rest[1]) if which == "density" else (at_rest[0], around(moved))
            ends.append(scale * ((rgb + left * far - images.reshape(-1, 3)) ** 2).sum())
        return (ends[0] - ends[1]) / 2e-4

    at_rest = before(density), around(values)
    found = grad.numpy()
    seen = np.argwhere(np.abs(found) > 0.2 * np.abs(found).max(axis=(0, 1)))
    for channel in range(4):
        for at in map(tuple, random.permutation(seen[seen[:, 2] == channel])[:3]):
            expected = slope(values, at, "values")
            assert abs(found[at] - expected) < 2e-3 * np.abs(found[..., channel]).max() + 1e-3 * abs(expected)
    assert (found[-1, :, 3] == 0).all()  # the last layer is opaque, whatever its value
    links = field.grid.links.numpy()
    largest = np.abs(grad_density).max()
    for node in map(tuple, random.permutation(np.argwhere(links >= 0))[:4]):
        expected = slope(density, node, "density")
        assert abs(grad_density[links[node]] - expected) < 1e-3 * largest + 1e-3 * abs(expected)


def test_variation_gradient_matches_finite_differences(device):
    side = 3
    background, values = oracle.random_background(device, side=side, layers=3)
    random = np.random.default_rng(2)
    moments = (random.random((3, surface_node_count(side), 4)) < 0.5).astype(np.float32)
    moments[random.random(moments.shape[:2]) < 0.3] = 0.0
    seen = (moments != 0).any(axis=-1)
    grad = wp.zeros(background.layers.values.shape, dtype=wp.vec4, device=device)
    scales = np.array([0.2, 0.2, 0.2, 0.7])
    wp.launch(
        background_loss.accumulate_layer_variation,
        dim=grad.size,
        device=device,
        inputs=[0, background.layers, wp.array(moments, dtype=wp.vec4, device=device), 5, 0.2, 0.7],
        outputs=[grad],
    )
    points = [tuple(point) for point in oracle.surface_points(side)]
    number = {point: n for n, point in enumerate(points)}

    def variation(values):
        total = 0.0
        for layer in range(3):
            for n, point in enumerate(points):
                if not seen[layer, n]:
                    continue
                squares = np.full(4, 1e-9)
                for axis in range(3):
                    other = number.get(tuple(np.add(point, np.eye(3, dtype=int)[axis])))
                    if other is not None and seen[layer, other]:
                        squares += (values[layer, other] - values[layer, n]) ** 2
                total += scales @ np.sqrt(squares)
        return total

    found = grad.numpy()
    assert (found[~seen] == 0).all()
    oracle.assert_slopes(found, values, variation, every=17)


# Fits of a room


SMALL = {"resolution": 32, "levels": 2, "epochs": 6, "batch_rays": 1024, "progress": False}
SMALL |= {"background": "layers", "background_layers": 6}


@pytest.fixture(scope="module")
def rooms():
    """The scene's pictures and the field fitted to them, whole and split."""
    result = {}
    for masks in (False, "split"):
        scene = room_scene(24, 32, masks=masks)
        result[masks] = scene, warpcage.fit(scene, **SMALL)
    return result


@pytest.mark.parametrize("masks", [False, "split"])
def test_a_room_is_seen_from_new_places(rooms, masks):
    _scene, field = rooms[masks]
    assert field.background_model is not None and field.background_model.layer_count == 6
    test = room_scene(5, 32, masks="split", turn=0.13)
    rows = warpcage.evaluate(field, test)
    assert np.mean([row["psnr"] for row in rows]) > 24
    assert np.mean([row["masked_psnr"] for row in rows]) > 19
    outside = test.alphas == 0
    renders = np.stack([field.render(camera).rgb for camera in test.cameras])
    assert warpcage.psnr(renders[outside], test.whole[outside]) > 26
    if masks:  # the model stands alone in the voxels
        opacity = np.stack([field.render(camera).alpha for camera in test.cameras])
        assert np.abs(opacity - test.alphas).mean() < 0.03
        alone = np.stack([field.render(camera, background="white").rgb for camera in test.cameras])
        assert warpcage.psnr(alone, test.images) > 19


def test_a_color_instead_of_layers(rooms):
    scene, field = rooms["split"]
    camera = scene.cameras[0]
    plain, seen = field.render(camera, background="black"), field.render(camera)
    origins, directions = (each.reshape(-1, 3) for each in camera.rays())
    behind = field.background_model.sample(origins, directions).reshape(32, 32, 3)
    np.testing.assert_allclose(seen.rgb, plain.rgb + (1 - plain.alpha[..., None]) * behind, atol=2e-3)
    for name in ("alpha", "depth", "disparity"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(plain, name))


@pytest.mark.parametrize("format", ["warpcage", "compact"])
def test_layers_are_saved_and_loaded(rooms, tmp_path, format):
    scene, field = rooms["split"]
    field.save(tmp_path / "f.npz", format=format)
    again = warpcage.VoxelField.load(tmp_path / "f.npz")
    model, loaded = field.background_model, again.background_model
    np.testing.assert_array_equal(loaded.center, model.center)
    assert (loaded.half, loaded.side, loaded.layer_count) == (model.half, model.side, model.layer_count)
    np.testing.assert_allclose(loaded.values[..., :3], model.values[..., :3], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(np.exp(-loaded.values[:-1, :, 3]), np.exp(-model.values[:-1, :, 3]), atol=1 / 255)
    camera = scene.cameras[0]
    assert warpcage.psnr(again.render(camera).rgb, field.render(camera).rgb) > 38
    again.save(tmp_path / "g.npz", format=format)
    np.testing.assert_array_equal(warpcage.VoxelField.load(tmp_path / "g.npz").background_model.values, loaded.values)
    scaled = warpcage.VoxelField.load(tmp_path / "f.npz", scene_scale=0.5).background_model
    assert scaled.half == 2 * model.half


def test_files_are_of_the_oldest_version_that_holds_them(tmp_path, rooms):
    """So that older releases read what they can."""
    model = rooms["split"][1].background_model
    for numbers, layers, version in (((9, 3), None, 1), ((9, 3), model, 2), ((24,), None, 3), ((24,), model, 3)):
        grid = oracle.random_field(None, numbers=numbers)[0].grid
        field = warpcage.VoxelField([[0] * 3, [1] * 3], grid.links, grid.density, grid.sh, background_model=layers)
        field.save(tmp_path / "f.npz")
        assert np.load(tmp_path / "f.npz")["version"] == version
        read = warpcage.VoxelField.load(tmp_path / "f.npz")
        assert read.grid.sh.shape == grid.sh.shape and (read.background_model is None) == (layers is None)
        if layers is not None and len(numbers) == 2:
            with pytest.warns(UserWarning, match="without its background layers"):
                field.save(tmp_path / "p.npz", format="svox2")


CAGE = warpcage.Cage.box([-1.0, -0.8, -0.9], [1.3, 0.8, 1.1])
EMPTY = warpcage.Cage.box([-1.0, 0.9, -0.9], [1.0, 1.0, -0.5])


@pytest.mark.parametrize(
    "edits, resolution, coordinates",
    [(CAGE, 24, "harmonic"), (CAGE, None, "mean_value"), ([CAGE, EMPTY], 24, "mean_value")],
)
def test_the_background_stays_while_the_object_moves(rooms, device, edits, resolution, coordinates):
    """The moved object is what the field alone shows of it; behind it is what was there before, also where it was."""
    field = rooms["split"][1].to(device)
    camera = room_cameras(1, 48, 0.3)[0]
    deformer = warpcage.Deformer(field, edits, coordinates=coordinates, resolution=resolution)
    moved = CAGE.scale(0.35).translate([0.0, 0.0, 1.35])  # clear of where it was
    frame = deformer.pose(moved if edits is CAGE else [moved, EMPTY]).render(camera)
    alone = deformer.render(camera, background="black")
    origins, directions = (each.reshape(-1, 3) for each in camera.rays())
    behind = field.background_model.sample(origins, directions).reshape(48, 48, 3)
    np.testing.assert_allclose(frame.rgb, alone.rgb + (1 - alone.alpha[..., None]) * behind, atol=2e-3)
    cleared = (field.render(camera).alpha > 0.9) & (frame.alpha < 1e-4)
    assert cleared.sum() > 40 and frame.reveal[cleared].min() > 0.5
    np.testing.assert_allclose(frame.rgb[cleared], behind[cleared], atol=2e-3)
    assert (frame.alpha > 0.9).sum() > 20


def test_baked_scenes_keep_their_layers(rooms):
    field = rooms["split"][1]
    baked = warpcage.bake(warpcage.Deformer(field, CAGE, resolution=24).pose(CAGE.scale(0.8)), resolution=32)
    assert baked.background_model is not None
    camera = room_cameras(1, 32, 0.3)[0]
    frame = baked.render(camera)
    empty = frame.alpha == 0
    np.testing.assert_allclose(frame.rgb[empty], field.render(camera).rgb[empty], atol=1.0)
    origins, directions = (each.reshape(-1, 3) for each in camera.rays())
    behind = field.background_model.sample(origins, directions).reshape(32, 32, 3)
    np.testing.assert_allclose(frame.rgb[empty], behind[empty], atol=1e-5)


# What stands behind the pictures


def test_what_stands_behind_is_chosen():
    whole, split = (room_scene(3, 16, masks=masks) for masks in (False, "split"))
    cut = warpcage.Scene(split.images, split.alphas, split.cameras)
    plain = warpcage.Scene(split.images, None, split.cameras)  # on white, opacity lost
    chosen = [chosen_background(scene, "auto") for scene in (whole, split, cut, plain)]
    assert chosen == [(False, "outer"), (True, "layers"), (True, None), (False, None)]
    assert chosen_background(whole, "layers") == (False, "layers")
    assert chosen_background(plain, "layers") == (False, "layers")
    assert chosen_background(whole, "outer") == (False, "outer")
    assert chosen_background(whole, "constant") == (False, None)
    assert chosen_background(split, "random") == (True, None)
    for scene, kind, message in (
        (cut, "layers", "split"),
        (whole, "random", "no opacity"),
        (whole, "sky", "background must be one of auto"),
    ):
        refused(functools.partial(warpcage.fit, scene, background=kind, progress=False), match=message)


def test_layers_keep_within_the_memory_given():
    scene = room_scene(6, 16, masks="split")
    options = {name: value for name, value in SMALL.items() if name != "progress"} | {"background_side": 512}
    optimizer = FieldOptimizer(scene, max_memory="64MB", **options)
    layers = 6 * surface_node_count(optimizer.background.sides[-1]) * 16 * (2 + optimizer.shards)
    assert optimizer.background.sides[-1] < 512 and layers < 64e6 / 4
    for name, value in (("background_layers", 1), ("background_detail", 0.0), ("view_share", 2)):
        refused(functools.partial(FieldOptimizer, scene, **{name: value}), match=name)


def test_split_pictures_are_whole_together(tmp_path):
    folder = write_room(tmp_path / "dtu", 9, 24)
    whole, split = (warpcage.load_scene(folder, split="all", masks=masks) for masks in (False, "split"))
    cut = warpcage.load_scene(folder, split="all", background="black")
    assert whole.alphas is None and cut.surroundings is None
    np.testing.assert_allclose(split.whole, whole.images, atol=1e-6)
    np.testing.assert_array_equal(split.alphas, cut.alphas)
    np.testing.assert_allclose(cut.images + split.surroundings, whole.images, atol=1e-6)
    small = warpcage.load_scene(folder, split="all", masks="split", downscale=2)
    np.testing.assert_allclose(small.whole, whole.images.reshape(9, 12, 2, 12, 2, 3).mean(axis=(2, 4)), atol=1e-5)
    for array in (folder / "mask").iterdir():
        array.unlink()
    (folder / "mask").rmdir()
    refused(lambda: warpcage.load_scene(folder, masks="split"), match="mask file")
    refused(lambda: warpcage.load_scene(folder, masks="cut"), match="masks must be")
    refused(lambda: warpcage.load_scene(folder, background="random"), match="random backgrounds are drawn")
    with pytest.raises(ValueError, match="surroundings must be"):
        warpcage.Scene(whole.images, None, whole.cameras, surroundings=whole.images)


def test_a_fit_with_layers_goes_on_from_its_checkpoint(tmp_path):
    scene = room_scene(6, 16, masks="split")
    options = {name: value for name, value in SMALL.items() if name != "progress"} | {"resolution": 16}
    through, stopped, resumed = (FieldOptimizer(scene, **options) for _ in range(3))
    for step in range(through.total_steps):
        through.step()
        if step < through.total_steps * 2 // 3:
            stopped.step()
    save_progress(stopped, tmp_path / "c.npz")
    load_progress(resumed, tmp_path / "c.npz")
    assert resumed.level == 1
    np.testing.assert_allclose(
        resumed.background.layers.values.numpy(), stopped.background.layers.values.numpy(), atol=2e-6
    )
    while resumed.step_count < resumed.total_steps:
        resumed.step()
    psnrs = [mean_psnr(warpcage.evaluate(optimizer.finish(), scene)) for optimizer in (through, resumed)]
    assert abs(psnrs[0] - psnrs[1]) < 0.1
    contents = dict(np.load(tmp_path / "c.npz"))
    for change in (
        {"layers_values": np.zeros((2, 4))},
        {"layers_met": np.zeros(2, np.uint8)},
        {"layers_moments": np.full_like(contents["layers_moments"], -1)},
    ):
        np.savez(tmp_path / "d.npz", **(contents | change))
        with pytest.raises(ValueError, match="damaged fit checkpoint"):
            load_progress(FieldOptimizer(scene, **options), tmp_path / "d.npz")


def test_the_way_on_the_command_line(tmp_path, capsys):
    folder, field = write_room(tmp_path / "dtu", 17, 24), tmp_path / "room.npz"
    arguments = ["--resolution", "24", "--epochs", "3", "--quiet"]
    assert main(["fit", str(folder), "-o", str(field), "--split-masks", *arguments]) == 0
    assert "16 background layers" in capsys.readouterr().out
    assert main(["info", str(field)]) == 0
    assert "16 layers of 6x" in capsys.readouterr().out
    report = tmp_path / "r.json"
    assert main(["evaluate", str(field), str(folder), "--split-masks", "--json", str(report), "--quiet"]) == 0
    assert "in mask dB" in capsys.readouterr().out
    figures = json.loads(report.read_text())
    assert figures["mean_psnr"] > 15 and figures["mean_masked_psnr"] > 11
    assert main(["evaluate", str(field), str(folder), "--json", str(report), "--quiet"]) == 0  # cut out, on white
    assert json.loads(report.read_text())["mean_psnr"] > 12
    CAGE.save(tmp_path / "cage.obj")
    view = ["--camera", f"{folder}:test:1", "--cage", str(tmp_path / "cage.obj"), "--posed", "scale:0.5"]
    assert main(["render", str(field), "-o", str(tmp_path / "layers.png"), *view]) == 0
    assert main(["render", str(field), "-o", str(tmp_path / "grey.png"), *view, "--background", "grey"]) == 0
    layers, grey = (read_image(tmp_path / f"{name}.png") for name in ("layers", "grey"))
    assert np.ptp(layers[0], axis=0).max() > 0.1 and np.ptp(grey[0], axis=0).max() < 0.01
    assert main(["fit", str(folder), "-o", str(tmp_path / "cut.npz"), "--background", "layers", *arguments]) == 2
    assert "split" in capsys.readouterr().err


# Voxels that the pictures say too little of


def test_voxels_that_few_cameras_see_stay_empty(device):
    scene = room_scene(8, 16, masks=False)
    mask = wp.ones((9, 8, 7), dtype=wp.uint8, device=device)
    keep_seen([[-4, -4, -4], [4, 4, 4]], scene.cameras, 6, mask)
    low, size = np.array([-4, -4, -4]), 8 / np.array([9, 8, 7])
    centers = low + (np.indices((9, 8, 7)).reshape(3, -1).T + 0.5) * size
    counts = np.zeros(len(centers), int)
    for camera in scene.cameras:
        pixels, depth = camera.project(centers)
        counts += (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= 16).all(axis=1)
    np.testing.assert_array_equal(mask.numpy().ravel(), counts >= 6)
    assert 0 < (counts >= 6).sum() < counts.size


def test_silhouettes_that_touch_the_border_carve_beyond_it(device):
    """A bar that leaves the image on the right: what is beyond the other borders goes, its continuation stays."""
    camera = warpcage.Camera(16.0, 16.0, 8.0, 8.0, 16, 16, np.eye(4))
    alphas = np.zeros((1, 16, 16), np.float32)
    alphas[0, 6:10, 5:] = 1.0
    wide = dataclasses.replace(camera, fx=4.0, fy=4.0)  # opaque all over, so that each voxel is in a picture
    scene = warpcage.Scene(np.ones((2, 16, 16, 3)), np.concatenate([alphas, np.ones_like(alphas)]), [camera, wide])
    silhouettes = Silhouettes(scene, wp.get_device(device))
    # at depth 16 a voxel is a pixel wide: node (i, j) is at pixel (i - 15.5, j - 15.5)
    kept = silhouettes.carve([[-24, -24, 15.5], [24, 24, 16.5]], (48, 48, 2)).numpy().any(axis=2)
    row, column = np.meshgrid(np.arange(48) - 15.5, np.arange(48) - 15.5)  # [column, row] of the picture
    right = column > 18
    assert kept[right & (np.abs(row - 8) < 3)].all()  # the bar goes on
    assert kept[right & (np.abs(row - 8) < 2 + 2.5 * (column - 16))].all()  # and may widen
    assert not kept[(column < -2) & (row > 1) & (row < 15)].any()
    assert not kept[((row < -2) | (row > 18)) & (column > 1) & (column < 15)].any()
