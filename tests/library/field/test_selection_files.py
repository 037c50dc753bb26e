"""Selection files, views of selections, and what commands make of them; from pictures to a lamp that moved."""

import functools
import json

import numpy as np
import pytest
import trimesh
from fields import GridField
from refusals import refused
from runs import succeed
from scenes import BALL, LAMP, TableScene

import warpcage
from warpcage import NodeSelection, Scene, select_nodes, select_object
from warpcage.demo import box, cylinder, joined, reference_cameras, render_mesh_views, spread_eyes


@pytest.fixture(scope="module")
def table():
    return TableScene(degrees=8.0, floor=False, fragments=False)


@pytest.fixture(scope="module")
def lamp(table):
    return select_object(table.field, point=table.world((-0.15, 0.1, 0.2)))


@pytest.fixture(scope="module")
def files(tmp_path_factory, table, lamp):
    folder = tmp_path_factory.mktemp("select")
    table.field.save(folder / "table.npz")
    lamp.save(folder / "lamp.npz")
    lamp.save(folder / "lamp.json")
    return folder


@pytest.mark.parametrize("name", ["lamp.npz", "lamp.json"])
def test_a_file_holds_the_selection_to_the_bit(files, table, lamp, name):
    for field in (table.field, warpcage.VoxelField.load(files / "table.npz", device="cpu")):
        back = NodeSelection.load(files / name, field)
        assert np.array_equal(back.mask, lamp.mask) and back.notes == lamp.notes
        assert np.array_equal(back.floor.normal, lamp.floor.normal) and back.floor.offset == lamp.floor.offset
    assert (files / name).stat().st_size < 20_000


def test_a_compact_file_of_the_field_will_do(files, table, tmp_path):
    table.field.save(tmp_path / "compact.npz", format="compact")
    field = warpcage.VoxelField.load(tmp_path / "compact.npz", device="cpu")
    assert NodeSelection.load(files / "lamp.npz", field).mask.any()


@pytest.mark.parametrize("ending", ["npz", "json"])
def test_any_mask_comes_back(tmp_path, ending):
    random = np.random.default_rng(2)
    field = GridField(random.uniform(1, 2, (5, 7, 9)))
    for mask in (random.uniform(size=(5, 7, 9)) < 0.4, np.ones((5, 7, 9), bool), np.zeros((5, 7, 9), bool)):
        mask[2, 3, 4] = True
        NodeSelection(field, mask, ("a note",)).save(tmp_path / f"s.{ending}")
        back = NodeSelection.load(tmp_path / f"s.{ending}", field)
        assert np.array_equal(back.mask, mask) and back.floor is None and back.notes == ("a note",)


def test_files_for_other_fields_and_damaged_ones(files, table, lamp, tmp_path):
    other = TableScene(degrees=9.0, floor=False, fragments=False)
    wrong = [(files / "lamp.npz", other.field, "is of another field in the same box")]
    wrong.append((files / "lamp.npz", TableScene(32).field, "is of another field, of 64x64x64 voxels"))
    moved = GridField(table.field.node_densities(), upper=(1, 1, 1.1))
    wrong.append((files / "lamp.json", moved, "is of another field, from"))
    document = json.loads((files / "lamp.json").read_text())
    changes = {
        "format": ("warpcage cameras", "not a selection file"),
        "version": (9, "of version 9"),
        "runs": ([10**9], "no more voxels than it says"),
        "begin": ([60, 60, 60], "leaves the field"),
        "shape": ([1, 2], "three whole numbers"),
        "resolution": ([1e9, 2, 2], "three whole numbers"),
        "bounds": ([[0, 0, 0]], "two corners"),
        "floor": ({"normal": [0, 0, 0], "offset": 1}, "must have a normal"),
        "occupied": (None, "another field"),
    }
    for name, (value, message) in changes.items():
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({**document, name: value}))
        wrong.append((path, table.field, message))
    lacking = {key: value for key, value in document.items() if key != "runs"}
    (tmp_path / "lacking.json").write_text(json.dumps(lacking))
    wrong.append((tmp_path / "lacking.json", table.field, "lacks 'runs'"))
    (tmp_path / "cut.npz").write_bytes((files / "lamp.npz").read_bytes()[:200])
    wrong.append((tmp_path / "cut.npz", table.field, "selection file"))
    np.savez(tmp_path / "numbers.npz", selection=np.zeros(3), chosen=np.zeros(3, np.uint8))
    wrong.append((tmp_path / "numbers.npz", table.field, "not a selection file"))
    wrong.append((files / "table.npz", table.field, "not a selection file"))
    NodeSelection(table.field, np.zeros_like(lamp.mask)).save(tmp_path / "empty.npz")
    wrong.append((tmp_path / "empty.npz", table.field, "holds no voxels"))
    for path, field, message in wrong:
        refused(functools.partial(NodeSelection.load, path, field), message, path.name)
    refused(lambda: NodeSelection.load(tmp_path / "none.npz", table.field), error=FileNotFoundError)
    refused(lambda: lamp.save(tmp_path / "lamp.txt"), match="must end in .npz or .json")
    assert not (tmp_path / "lamp.txt").exists()


def test_the_preview_tints_what_is_chosen_alone(table, lamp, device):
    field = table.field.to(device)
    camera = table.camera()
    chosen = NodeSelection(field, lamp.mask)
    tinted, plain = chosen.preview(camera), np.clip(field.render(camera).rgb, 0, 1)
    changed = np.abs(tinted - plain).max(axis=-1)
    pixels = np.floor(camera.project(table.cells[table.labels == BALL])[0]).astype(int)
    of_ball = changed[pixels[:, 1], pixels[:, 0]]
    assert np.median(of_ball) == 0.0 and of_ball.max() < 0.05
    column, row = table.pixel_of(camera, LAMP)
    assert np.allclose(tinted[row, column], 0.45 * plain[row, column] + 0.55 * np.array([0.1, 0.9, 0.2]), atol=0.03)
    everything = NodeSelection(field, np.ones_like(lamp.mask)).preview(camera, strength=1.0)
    opaque = field.render(camera).alpha > 0.999
    assert np.allclose(everything[opaque], [0.1, 0.9, 0.2], atol=0.02)


def test_what_is_cut_out_is_alone(table, lamp, device):
    field = table.field.to(device)
    alone = NodeSelection(field, lamp.mask).cut_out()
    inside = lamp.mask.ravel()
    ways = np.broadcast_to([0.0, 0.0, 1.0], (inside.sum(), 3))
    for one, two in zip(field.sample(table.cells[inside], ways), alone.sample(table.cells[inside], ways), strict=True):
        assert np.allclose(one, two, atol=1e-6)
    assert alone.voxel_count < 0.4 * field.voxel_count
    # the box ends a voxel beyond the lamp, and what else is in it is empty
    voxel, own = np.asarray(field.voxel_size), table.cells[inside]
    expected = np.clip([own.min(axis=0) - 1.5 * voxel, own.max(axis=0) + 1.5 * voxel], *field.bounds)
    assert np.allclose(alone.bounds, expected, atol=1e-9) and np.allclose(alone.voxel_size, voxel, atol=1e-9)
    within = ((table.cells > alone.bounds[0]) & (table.cells < alone.bounds[1])).all(axis=1)
    assert not alone.node_densities().ravel()[~inside[within]].any()
    refused(lambda: NodeSelection(field, np.zeros_like(lamp.mask)).cut_out(), match="nothing is chosen")
    refused(lambda: select_nodes(GridField(np.ones((8, 8, 8)) * 50)).cut_out(), match="must be of a VoxelField")


def test_select_from_the_command_line(files, table, lamp, capsys):
    point = table.world((-0.15, 0.1, 0.2)).tolist()
    succeed(files, "select", "@table.npz", "-o", "@one.npz", "--point", *point, "--preview", "@one.png", "--size", "60")
    said = capsys.readouterr().out
    assert "above the ground plane" in said and "voxels, from" in said and "one.png" in said
    assert np.array_equal(NodeSelection.load(files / "one.npz", table.field).mask, lamp.mask)
    table.camera((-2.2, 1.0, 1.4), 48).resized(48, 48)
    warpcage.CameraFile([table.camera()]).save(files / "camera.json")
    column, row = table.pixel_of(table.camera(), LAMP)
    arguments = ("--camera", "@camera.json", "--pixel", column, row)
    succeed(files, "select", "@table.npz", "-o", "@two.json", *arguments)
    assert np.array_equal(NodeSelection.load(files / "two.json", table.field).mask, lamp.mask)
    ball = table.world((0.4, -0.3, -0.05)).tolist()
    succeed(files, "select", "@table.npz", "-o", "@ball.npz", "--sphere", *ball, 0.25)
    chosen = NodeSelection.load(files / "ball.npz", table.field)
    assert set(table.labels[chosen.mask.ravel()].tolist()) == {BALL}
    turns = np.arange(6) * np.pi / 3
    views = [table.camera((2.9 * np.cos(a), 2.9 * np.sin(a), 1.7), 60) for a in turns]
    warpcage.CameraFile(views).save(files / "views.json")
    arguments = ("--depth", 2.5, 4.2, "--views", "@views.json", "--parts", 1)
    succeed(files, "select", "@table.npz", "-o", "@near.npz", *arguments)
    assert set(table.labels[NodeSelection.load(files / "near.npz", table.field).mask.ravel()].tolist()) == {LAMP}


def test_commands_take_a_selection(files, table, lamp, capsys):
    succeed(files, "cage", "@table.npz", "-o", "@lamp.obj", "--selection", "@lamp.npz", "--vertices", "50")
    cage = warpcage.Cage.load(files / "lamp.obj")
    assert cage.contains(lamp.points).all() and lamp.floor.heights(cage.vertices).min() > -1e-6
    succeed(files, "mesh", "@table.npz", "-o", "@lamp.ply", "--selection", "@lamp.json", "--colors")
    mesh = trimesh.load(files / "lamp.ply", process=False)
    assert np.abs(mesh.bounds - [lamp.points.min(axis=0), lamp.points.max(axis=0)]).max() < 0.05
    red = np.asarray(mesh.visual.vertex_colors)[:, :3].mean(axis=0)
    assert red[0] > 2 * red[1:].max()
    succeed(files, "bake", "@table.npz", "-o", "@alone.npz", "--selection", "@lamp.npz")
    alone = warpcage.VoxelField.load(files / "alone.npz", device="cpu")
    ends = np.rint((alone.bounds - lamp.bounds[0]) / lamp.voxel_size).astype(int)
    assert np.array_equal(alone.node_densities() > 0, lamp.mask[tuple(map(slice, *ends))])
    assert np.count_nonzero(alone.node_densities() > 0) == np.count_nonzero(lamp.mask)
    arguments = ("--cage", "@lamp.obj", "--posed", "scale:0.8", "--voxels", "32", "--resolution", "24")
    succeed(files, "bake", "@table.npz", "-o", "@small.npz", "--selection", "@lamp.npz", *arguments)
    small = warpcage.VoxelField.load(files / "small.npz", device="cpu")
    assert np.ptp(small.bounds, axis=0).max() < 0.95  # the table is not there
    succeed(
        files, "cage", "@table.npz", "-o", "@top.obj", "--selection", "@lamp.npz", "--in-box", *(-1, -1, 0.2, 1, 1, 1)
    )
    assert warpcage.Cage.load(files / "top.obj").bounds[0, 2] > 0.05


def lamp_on_a_table(offset=(0, 0, 0)):
    """A mesh: a striped table with a block on it, and a lamp that may have moved."""
    still = [
        box((-0.9, -0.8, -0.45), (0.9, 0.8, -0.3), (0.6, 0.45, 0.25)),
        box((-0.45, -0.8, -0.2999), (-0.25, 0.8, -0.29), (0.2, 0.5, 0.3)),
        box((0.5, -0.7, -0.3), (0.7, -0.5, -0.05), (0.2, 0.3, 0.8)),
    ]
    lamp = [
        cylinder((0, 0, -0.3), (0, 0, 0.2), 0.1, (0.9, 0.8, 0.2), segments=16),
        box((-0.25, -0.15, 0.15), (0.25, 0.15, 0.4), (0.8, 0.1, 0.5)),
    ]
    return joined(still + [(vertices + np.asarray(offset), faces, color) for vertices, faces, color in lamp])


def seen(camera, cage):
    """(h, w) bool, pixels that see a cage."""
    from skimage.draw import polygon

    mask = np.zeros((camera.height, camera.width), bool)
    pixels, _ = camera.project(cage.vertices)
    for face in cage.faces:
        mask[polygon(pixels[face, 1], pixels[face, 0], mask.shape)] = True
    return mask


def test_from_pictures_to_a_lamp_that_moved(tmp_path, device):
    def pictures(cameras, offset=(0, 0, 0)):
        rgba = render_mesh_views(*lamp_on_a_table(offset), cameras, samples=2, device=device)
        return rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], rgba[..., 3]

    cameras = reference_cameras(spread_eyes(24, 0), np.zeros(3), 48)
    images, alphas = pictures(cameras)
    scene = Scene(images, alphas, cameras)
    field = warpcage.fit(scene, quality="fast", resolution=56, epochs=8, device=device, progress=False)
    field.save(tmp_path / "table.npz")
    view = warpcage.Camera.look_at((1.6, -3.2, 1.7), (0, 0, 0), fov_degrees=39.6, width=120, height=120)
    warpcage.CameraFile([view]).save(tmp_path / "view.json")
    column, row = np.floor(view.project(np.array([[0.0, -0.15, 0.28]]))[0][0]).astype(int)
    click = ("--camera", "@view.json", "--pixel", column, row)
    succeed(tmp_path, "select", "@table.npz", "-o", "@lamp.npz", *click, "--device", device)
    arguments = ("--selection", "@lamp.npz", "--vertices", "60", "--device", device)
    succeed(tmp_path, "cage", "@table.npz", "-o", "@lamp.obj", *arguments)

    cage, offset = warpcage.Cage.load(tmp_path / "lamp.obj"), np.array([0.2, 0.1, 0.3])
    posed = cage.translate(offset)
    edited = warpcage.Deformer(field, cage, resolution=48).pose(posed).render(view).rgb
    before, (at_rest, moved) = field.render(view).rgb, (pictures([view], each)[0][0] for each in ((0, 0, 0), offset))
    start, end = seen(view, cage), seen(view, posed)

    def error(one, two, where):
        return -10 * np.log10(np.mean((one - two)[where] ** 2))

    aside = ~(start | end)
    assert np.abs(edited - before)[aside].max() < 0.02  # the table is still
    assert error(edited, moved, aside) > 27 and error(edited, moved, aside) > error(before, at_rest, aside) - 1
    assert error(edited, moved, end) > 18 > 9 > error(before, moved, end)  # the lamp is where it should be
    assert error(edited, moved, start & ~end) > 17 > 12 > error(before, moved, start & ~end)  # and left where it was
