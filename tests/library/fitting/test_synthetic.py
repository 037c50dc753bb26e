"""The project's own scene: its model, its ray caster, its folder."""

import json

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.csgraph
from refusals import refused

import warpcage.demo.brick_scene as synthetic
from warpcage import Camera, load_scene
from warpcage.demo import brick_model, render_mesh_views, write_brick_scene
from warpcage.view import read_image

BOX_VERTICES = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float) * (0.5, 0.3, 0.4)
BOX_FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
                      [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip


def box_is_hit(camera, offset):
    """Slab test of the box for the ray through each pixel centre, float64, (h, w)."""
    origins, directions = camera.rays()
    with np.errstate(divide="ignore"):
        crossings = np.stack([BOX_VERTICES.min(axis=0), BOX_VERTICES.max(axis=0)])[:, None, None] + offset - origins
        crossings = crossings / directions
    return crossings.min(axis=0).max(axis=-1) < crossings.max(axis=0).min(axis=-1)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, -3e5, 1e4)])
def test_silhouette_of_a_box_is_exact(device, offset):
    offset = np.array(offset)
    camera = Camera.look_at(offset + (1.7, -2.2, 1.1), offset + (0.1, 0.0, 0.05), fov_degrees=35, width=61, height=47)
    view = render_mesh_views(BOX_VERTICES + offset, BOX_FACES, np.ones((12, 3)), [camera], samples=1, device=device)[0]
    expected = box_is_hit(camera, offset)
    assert 0.1 < expected.mean() < 0.6
    assert (view[..., 3].astype(bool) != expected).mean() < 0.002  # rays within rounding of an edge
    np.testing.assert_array_equal(np.unique(view[..., 3]), [0.0, 1.0])
    assert (view[~expected & (view[..., 3] == 0)] == 0).all()


def test_supersampling_gives_the_covered_share(device):
    """A half plane x < edge before the camera: coverage of the pixel column that the edge cuts."""
    camera = Camera(10.0, 10.0, 4.0, 4.0, 8, 8, np.eye(4))
    for cut, share in ((4.5, 0.5), (4.3, 0.25), (4.8, 0.75)):
        x = (cut - 4.0) / 10.0
        vertices = [[-50, -50, 1], [x, -50, 1], [x, 50, 1], [-50, 50, 1]]
        plane = vertices, [[0, 1, 2], [0, 2, 3]], np.ones((2, 3))
        view = render_mesh_views(*plane, [camera], samples=4, device=device)[0]
        np.testing.assert_allclose(view[:, :4, 3], 1.0)
        np.testing.assert_allclose(view[:, 4, 3], share, atol=1e-6)
        np.testing.assert_allclose(view[:, 5:, 3], 0.0)


def test_light_comes_from_above_and_casts_shadows(device):
    """A floor under a small roof, seen from below the roof's height: dark under it, light beside it."""

    def square(size, height):
        return [[-size, -size, height], [size, -size, height], [size, size, height], [-size, size, height]]

    vertices = np.array(square(2.0, 0.0) + square(0.4, 0.5))
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), up=(0, 1, 0), fov_degrees=40, width=40, height=40)
    floor_only = render_mesh_views(vertices, faces[:2], np.ones((2, 3)), [camera], samples=1, device=device)[0]
    both = render_mesh_views(vertices, faces, np.ones((4, 3)), [camera], samples=1, device=device)[0]
    roof = np.abs(np.arange(40) - 19.5)[:, None] < 5, np.abs(np.arange(40) - 19.5)[None] < 5
    beside = ~(roof[0] & roof[1])
    darker = floor_only[..., :3].mean(axis=-1) - both[..., :3].mean(axis=-1)
    assert darker[beside].max() > 0.2  # the cast shadow falls beside the roof
    assert darker[beside].min() > -1e-6  # a roof never lights the floor
    # the key light comes from +x, -y: the shadow falls to -x, +y, on the picture's left and upper side
    rows, columns = np.nonzero((darker > 0.2) & beside)
    assert columns.mean() < 19.5 and rows.mean() < 19.5


def test_highlight_depends_on_the_view(device):
    floor = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float)
    eyes = [(-1.8, 2.4, 3.6), (1.8, 2.4, 3.6)]  # the first stands where the key light is mirrored to
    cameras = [Camera.look_at(eye, (0, 0, 0), width=9, height=9) for eye in eyes]
    views = render_mesh_views(floor, [[0, 1, 2], [0, 2, 3]], np.full((2, 3), 0.3), cameras, device=device)
    center = views[:, 4, 4, :3].mean(axis=-1)
    assert center[0] - center[1] > 0.05


@pytest.mark.parametrize("change, message", [
    ({"faces": [[0, 1, 8]]}, "faces"), ({"colors": np.ones((3, 3))}, "per face"), ({"cameras": []}, "camera"),
    ({"vertices": np.full((8, 3), np.nan)}, "vertices"), ({"samples": 0}, "samples"),
])  # fmt: skip
def test_render_mesh_views_refuses(change, message):
    arguments = {"vertices": BOX_VERTICES, "faces": BOX_FACES, "colors": np.ones((12, 3)), "samples": 1,
                 "cameras": [Camera.look_at((0, -3, 0), (0, 0, 0), width=4, height=4)]} | change  # fmt: skip
    refused(lambda: render_mesh_views(**arguments), match=message)


def test_brick_model_is_closed_centered_and_in_the_box():
    vertices, faces, colors = brick_model()
    assert faces.dtype == np.int32 and colors.shape == faces.shape
    assert colors.min() >= 0.0 and colors.max() <= 1.0
    assert len(np.unique(colors, axis=0)) >= 8
    np.testing.assert_allclose(vertices.min(axis=0), -vertices.max(axis=0), atol=1e-12)
    assert 0.9 < np.abs(vertices).max() < 1.2
    # closed and consistently wound: every directed edge is met once in the other direction
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert set(map(tuple, edges)) == set(map(tuple, edges[:, ::-1]))
    # every part looks outward
    graph = scipy.sparse.coo_array((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    part_count, parts = scipy.sparse.csgraph.connected_components(graph, directed=False)
    corners = vertices[faces]
    cones = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert part_count > 100 and np.bincount(parts[faces[:, 0]], weights=cones).min() > 0


@pytest.fixture(scope="module")
def brick_scene(tmp_path_factory):
    return write_brick_scene(tmp_path_factory.mktemp("scene") / "bricks", train_views=5, test_views=2, size=32)


def test_scene_folder_is_nerf_synthetic(brick_scene):
    assert sorted(entry.name for entry in brick_scene.iterdir()) == ["test", "train", "transforms_test.json",
                                                                    "transforms_train.json"]  # fmt: skip
    transforms = json.loads((brick_scene / "transforms_train.json").read_text())
    assert 0.5 < transforms["camera_angle_x"] < 0.9 and len(transforms["frames"]) == 5
    assert transforms["frames"][0]["file_path"] == "./train/r_0"
    assert read_image(brick_scene / "train" / "r_0.png").shape == (32, 32, 4)
    for frame in transforms["frames"]:
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.norm(pose[:3, 3]) == pytest.approx(4.0) and pose[2, 3] > 0
        np.testing.assert_allclose(-pose[:3, 2], -pose[:3, 3] / 4, atol=1e-9)  # Blender looks along -z: at the origin
        assert pose[2, 1] > 0  # and its +y is up


def test_loaded_cameras_see_the_model_where_the_pictures_show_it(brick_scene):
    """The whole way round: camera written as Blender's, read as OpenCV's, projecting the model onto its silhouette."""
    vertices, faces, _ = brick_model()
    for split, count in (("train", 5), ("test", 2)):
        scene = load_scene(brick_scene, split=split)
        assert len(scene) == count
        for alpha, camera in zip(scene.alphas, scene.cameras, strict=True):
            pixels, depth = camera.project(vertices[faces].mean(axis=1))
            assert (depth > 0).all()
            column, row = np.floor(pixels).astype(int).T
            inside = (column >= 0) & (column < 32) & (row >= 0) & (row < 32)
            assert inside.mean() > 0.97
            covered = np.zeros((32, 32), bool)
            covered[row[inside], column[inside]] = True
            assert (alpha[covered] > 0).mean() > 0.95  # what is thinner than the samples may slip through
            seen = np.argwhere(alpha > 0.5)
            np.testing.assert_allclose(seen.min(axis=0), np.argwhere(covered).min(axis=0), atol=1)
            np.testing.assert_allclose(seen.max(axis=0), np.argwhere(covered).max(axis=0), atol=1)


def test_scene_depends_on_the_seed_only(tmp_path, brick_scene):
    again = write_brick_scene(tmp_path / "again", train_views=5, test_views=2, size=32)
    other = write_brick_scene(tmp_path / "other", train_views=5, test_views=2, size=32, seed=1)
    first = (brick_scene / "train" / "r_3.png").read_bytes()
    assert (again / "train" / "r_3.png").read_bytes() == first
    assert (other / "train" / "r_3.png").read_bytes() != first


def test_scene_is_complete_or_absent(tmp_path, monkeypatch):
    small = {"train_views": 2, "test_views": 1, "size": 8}
    real = synthetic.write_png
    written = []

    def fails_at_the_second(path, image):
        written.append(path)
        if len(written) == 2:
            raise OSError("disk full")
        real(path, image)

    monkeypatch.setattr(synthetic, "write_png", fails_at_the_second)
    with pytest.raises(OSError, match="disk full"):
        write_brick_scene(tmp_path / "scene", **small)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(synthetic, "write_png", real)

    write_brick_scene(tmp_path / "scene", **small)
    write_brick_scene(tmp_path / "scene", **(small | {"train_views": 1}))  # an earlier scene is replaced
    assert [entry.name for entry in (tmp_path / "scene" / "train").iterdir()] == ["r_0.png"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]

    (tmp_path / "scene" / "notes.txt").write_text("mine")
    refused(lambda: write_brick_scene(tmp_path / "scene", **small), match="is there")
    assert (tmp_path / "scene" / "notes.txt").exists()
    refused(lambda: write_brick_scene(tmp_path / "none", train_views=0), match="views")
