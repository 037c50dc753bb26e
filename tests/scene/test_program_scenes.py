"""Scenes of other programs come back: LLFF, Bundler, RealityScan, OpenSfM, Metashape. Each is compared with the cameras
that it was written from, and pixels of known points with the formulas of its own documentation."""

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from messages import MESSAGES
from program_writers import (
    SHADES,
    SQUARE,
    metashape_chunk,
    opensfm_reconstruction,
    write_bundler,
    write_llff,
    write_metashape,
    write_opensfm,
    write_realityscan,
)
from scene_writers import Pictures, brick_pictures
from scipy.spatial.transform import Rotation
from test_scene_formats import (
    LENSES,
    lens_pictures,
    load,
    picture_of,
    pixel_centers,
    require_equal,
    require_held_out_splits,
    require_undistorted,
)

from warpcage import load_scene


@pytest.fixture(scope="module")
def centered():
    return brick_pictures(10, centered=True)


def require_pixels(scene, expected, tolerance=1e-6):
    """expected: (n, k, 2) pixels of the points SQUARE in each picture, by the file's own formulas."""
    for camera, pixels in zip(scene.cameras, expected, strict=True):
        np.testing.assert_allclose(camera.project(SQUARE)[0], pixels, atol=tolerance)


# LLFF


def test_llff(tmp_path, centered):
    write_llff(tmp_path, centered)
    require_held_out_splits(tmp_path, centered)
    require_equal(load(tmp_path, split="all", format="llff"), centered)
    expected = []
    for row in np.load(tmp_path / "poses_bounds.npy"):
        matrix = row[:15].reshape(3, 5)
        down, right, back = ((SQUARE - matrix[:, 3]) @ matrix[:, :3]).T
        height, width, focal = matrix[:, 4]
        expected.append(np.stack([focal * right / -back + width / 2, focal * down / -back + height / 2], axis=1))
    require_pixels(load(tmp_path, split="all"), expected)


@pytest.mark.parametrize("downscale, taken", [(1, 1), (2, 2), (4, 4), (5, 1)])
def test_llff_takes_the_pictures_of_the_size_that_is_asked_for(tmp_path, centered, downscale, taken):
    black = Pictures(np.zeros_like(centered.rgba) + np.uint8([0, 0, 0, 255]), centered.cameras)
    write_llff(tmp_path, black, (1, 2, 4))
    white = Pictures(np.full_like(centered.rgba, 255), centered.cameras)
    write_llff(tmp_path, white, (taken,))
    scene = load(tmp_path, split="all", downscale=downscale)
    assert scene.images.min() > 0.999
    for read, written in zip(scene.cameras, centered.cameras, strict=True):
        assert (read.width, read.height) == (round(written.width / downscale), round(written.height / downscale))
        assert read.fx / read.width == pytest.approx(written.fx / written.width, rel=1e-12)


def test_llff_without_large_pictures_says_which_there_are(tmp_path, centered):
    write_llff(tmp_path, centered, (4, 2))
    with pytest.raises(FileNotFoundError, match=MESSAGES["scene.llff_sizes"]):
        load(tmp_path)
    assert load(tmp_path, downscale=2).cameras[0].width == 12


def test_llff_counts_poses_and_pictures(tmp_path, centered):
    write_llff(tmp_path, centered, rows=9)
    with pytest.raises(ValueError, match="has 9 poses, .*images 10 pictures"):
        load(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((10, 16)))
    with pytest.raises(ValueError, match=r"must be \(n, 17\)"):
        load(tmp_path)


def test_llff_pictures_of_another_shape_are_refused(tmp_path, centered):
    write_llff(tmp_path, centered)
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[:, 4] = 40.0
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=MESSAGES["scene.llff_shape"]):
        load(tmp_path)


# Bundler


@pytest.mark.parametrize("listing", ["list.txt", "bundle/list.txt", None])
def test_bundler(tmp_path, centered, listing):
    write_bundler(tmp_path, centered, listing=listing)
    require_held_out_splits(tmp_path, centered)
    scene = load(tmp_path, split="all", format="bundler")
    np.testing.assert_array_equal(scene.points, SQUARE)
    np.testing.assert_allclose(scene.point_colors, SHADES / 255, atol=1e-7)
    words = (tmp_path / "bundle" / "bundle.out").read_text().split("\n", 2)[2].split()
    expected = []
    for index in range(10):
        values = np.array(words[15 * index : 15 * index + 15], float)
        seen = SQUARE @ values[3:12].reshape(3, 3).T + values[12:]
        middle = -seen[:, :2] / seen[:, 2:] * values[0]  # from the middle of the picture, y up
        expected.append(np.stack([12 + middle[:, 0], 10 - middle[:, 1]], axis=1))
    require_pixels(scene, expected)


def test_bundler_pictures_without_a_camera_are_left_out(tmp_path, centered):
    write_bundler(tmp_path, centered, lost=(2, 5))
    with pytest.warns(UserWarning, match=MESSAGES["scene.without_camera"]):
        require_equal(load(tmp_path, split="all"), centered.pick([0, 1, 3, 4, 6, 7, 8, 9]))


def test_bundler_lenses_are_undone(tmp_path):
    pictures = lens_pictures(LENSES["barrel"], single_focal=True, middle=True)
    write_bundler(tmp_path, pictures, distortion=LENSES["barrel"])
    require_undistorted(load_scene(tmp_path), pictures)


# RealityScan


def test_realityscan(tmp_path, centered):
    write_realityscan(tmp_path, centered)
    require_held_out_splits(tmp_path, centered)
    scene = load(tmp_path, split="all", format="realityscan")
    expected = []
    for line in (tmp_path / "cameras.csv").read_text().splitlines()[1:]:
        x, y, alt, *angles, f, px, py = map(float, line.split(",")[1:10])
        (sh, sp, sr), (ch, cp, cr) = np.sin(np.radians(angles)), np.cos(np.radians(angles))
        heading = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])  # clockwise, as a compass has it
        pitch, roll = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]), np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
        right, up, back = ((SQUARE - [x, y, alt]) @ (heading @ pitch @ roll)).T
        focal = f / 36 * 24
        expected.append(np.stack([12 + 24 * px - focal * right / back, 10 + 24 * py + focal * up / back], axis=1))
    require_pixels(scene, expected)


@pytest.mark.parametrize("lens", ["barrel", "tangential", "all"])
def test_realityscan_lenses_are_undone(tmp_path, lens):
    pictures = lens_pictures(LENSES[lens], single_focal=True)
    k1, k2, t1, t2 = (*LENSES[lens], 0.0, 0.0)[:4]
    write_realityscan(tmp_path, pictures, lens=(k1, k2, 0.0, 0.0, t1, t2))
    require_undistorted(load_scene(tmp_path), pictures)


@pytest.mark.parametrize("lens", ["barrel", "tangential", "all"])
def test_realityscan_lenses_of_four_radial_coefficients(tmp_path, lens):
    """They are resampled in another way; with next to nothing as the fourth, to the same pictures."""
    pictures = lens_pictures(LENSES[lens], single_focal=True)
    k1, k2, t1, t2 = (*LENSES[lens], 0.0, 0.0)[:4]
    write_realityscan(tmp_path, pictures, lens=(k1, k2, 0.0, 1e-9, t1, t2))
    scene = load_scene(tmp_path)
    for image, read, written in zip(scene.images, scene.cameras, pictures.cameras[1:], strict=False):
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        error = np.abs(image - picture_of(read, pixel_centers(read)))[2:-2, 2:-2]
        assert read.width > 40 and error.max() < 0.01


# OpenSfM


@pytest.mark.parametrize("place", ["", "opensfm"])
def test_opensfm(tmp_path, bricks, place):
    write_opensfm(tmp_path, bricks, place=place)
    require_held_out_splits(tmp_path, bricks)
    scene = load(tmp_path, split="all", format="opensfm")
    np.testing.assert_array_equal(scene.points, SQUARE)
    np.testing.assert_allclose(scene.point_colors, SHADES / 255, atol=1e-7)
    content = json.loads((tmp_path / place / "reconstruction.json").read_text())[0]
    expected = []
    for name in sorted(content["shots"]):
        shot = content["shots"][name]
        camera = content["cameras"][shot["camera"]]
        x, y, z = (Rotation.from_rotvec(shot["rotation"]).apply(SQUARE) + shot["translation"]).T
        longer = max(camera["width"], camera["height"])
        u = (camera["focal_x"] * x / z + camera["c_x"]) * longer + camera["width"] / 2
        v = (camera["focal_y"] * y / z + camera["c_y"]) * longer + camera["height"] / 2
        expected.append(np.stack([u, v], axis=1))
    require_pixels(scene, expected)


@pytest.mark.parametrize("kind, lens", [("perspective", "barrel"), ("brown", "all")])
def test_opensfm_lenses_are_undone(tmp_path, kind, lens):
    single = kind == "perspective"
    pictures = lens_pictures(LENSES[lens], single_focal=single, middle=single)
    write_opensfm(tmp_path, pictures, kind=kind, **dict(zip(("k1", "k2", "p1", "p2"), LENSES[lens], strict=False)))
    require_undistorted(load_scene(tmp_path), pictures)


def test_opensfm_takes_the_largest_of_several(tmp_path, bricks):
    few = opensfm_reconstruction(bricks.pick([0, 1]))
    write_opensfm(tmp_path, bricks, others=[few, {"cameras": {}, "shots": {}}])
    with pytest.warns(UserWarning, match=MESSAGES["scene.most_shots"]):
        require_equal(load(tmp_path, split="all"), bricks)
    require_equal(load(tmp_path, split="all", model="0"), bricks.pick([0, 1]))
    with pytest.raises(ValueError, match="no reconstruction '3', only 0, 1, 2"):
        load(tmp_path, model="3")


# Metashape

TURN = np.eye(4)
TURN[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix()
TURN[:3, 3] = [3.5, -2.0, 11.0]


@pytest.mark.parametrize("owner", ["component", "chunk"])
@pytest.mark.parametrize("ending, home", [("", ""), (".png", "C:/photos/")])
@pytest.mark.parametrize("name", ["cameras.xml", "my capture.xml"])
@pytest.mark.filterwarnings("ignore:.*by paths of another folder")
def test_metashape(tmp_path, bricks, owner, ending, home, name):
    write_metashape(tmp_path, bricks, owner=owner, ending=ending, home=home, name=name, world=TURN, scale=2.5)
    require_held_out_splits(tmp_path, bricks)
    scene = load(tmp_path, split="all", format="metashape")
    chunk = ET.parse(tmp_path / name).getroot().find("chunk")
    part = chunk if owner == "chunk" else chunk.find("components/component")
    numbers = {each.tag: np.array(each.text.split(), float) for each in part.find("transform")}
    local = (SQUARE - numbers["translation"]) @ numbers["rotation"].reshape(3, 3) / numbers["scale"]
    expected = []
    for camera in sorted(chunk.iter("camera"), key=lambda camera: camera.get("label")):
        pose = np.array(camera.find("transform").text.split(), float).reshape(4, 4)
        x, y, z = (np.concatenate([local, np.ones((30, 1))], axis=1) @ np.linalg.inv(pose).T)[:, :3].T
        given = chunk.find(f"sensors/sensor[@id='{camera.get('sensor_id')}']/calibration[@class='adjusted']")
        value = {each.tag: float(each.text) for each in given if each.tag != "resolution"}
        u = 24 / 2 + value["cx"] + x / z * (value["f"] + value["b1"])
        expected.append(np.stack([u, 20 / 2 + value["cy"] + y / z * value["f"]], axis=1))
    require_pixels(scene, expected)


def test_metashape_in_coordinates_of_the_earth(tmp_path, bricks):
    """Millions of metres from the origin, as georeferenced chunks are."""
    world = TURN.copy()
    world[:3, 3] = [-2499366.0, -4256836.0, 4029217.0]
    far = [c.moved(np.block([[np.eye(3), world[:3, 3:]], [np.zeros((1, 3)), 1.0]])) for c in bricks.cameras]
    write_metashape(tmp_path, Pictures(bricks.rgba, far), world=world, scale=12.25)
    scene = load(tmp_path, split="all")
    for read, written in zip(scene.cameras, far, strict=True):
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-8)


@pytest.mark.parametrize("options", [{"disabled": (2, 5)}, {"lost": (2, 5)}])
def test_metashape_cameras_that_are_off_or_lost_are_left_out(tmp_path, bricks, options):
    write_metashape(tmp_path, bricks, **options)
    with pytest.warns(UserWarning, match=f"2 of 10 cameras .*: {2 * ('disabled' in options)} disabled"):
        require_equal(load(tmp_path, split="all"), bricks.pick([0, 1, 3, 4, 6, 7, 8, 9]))


def test_metashape_takes_the_largest_chunk(tmp_path, bricks):
    few = metashape_chunk(bricks.pick([0, 1]), label="few")
    write_metashape(tmp_path, bricks, others=[few])
    with pytest.warns(UserWarning, match=MESSAGES["scene.most_cameras"]):
        require_equal(load(tmp_path, split="all"), bricks)
    require_equal(load(tmp_path, split="all", model="few"), bricks.pick([0, 1]))


def test_metashape_components_that_nothing_connects(tmp_path, bricks):
    write_metashape(tmp_path, bricks)
    file = tmp_path / "cameras.xml"
    text = file.read_text()
    for index in (1, 3):
        text = text.replace(
            f'id="{index}" sensor_id="{index}" component_id="0"', f'id="{index}" sensor_id="{index}" component_id="1"'
        )
    file.write_text(text.replace("</components>", '<component id="1" label="Component 2"></component></components>'))
    with pytest.warns(UserWarning, match=MESSAGES["scene.cameras_left_out"]):
        require_equal(load(tmp_path, split="all"), bricks.pick([0, 2, 4, 5, 6, 7, 8, 9]))


def test_metashape_lenses_are_undone(tmp_path):
    k1, k2, p1, p2 = LENSES["all"]
    pictures = lens_pictures(LENSES["all"])
    write_metashape(tmp_path, pictures, lens={"k1": k1, "k2": k2, "p1": p2, "p2": p1})
    require_undistorted(load_scene(tmp_path), pictures)


def test_metashape_entities_are_refused(tmp_path, bricks):
    write_metashape(tmp_path, bricks)
    file = tmp_path / "cameras.xml"
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'
    file.write_text(file.read_text().replace("<document", f"{bomb}<document", 1))
    with pytest.raises(ValueError, match="cameras.xml defines entities"):
        load(tmp_path)


# All of them


WRITERS = {"llff": write_llff, "bundler": write_bundler, "opensfm": write_opensfm, "metashape": write_metashape}
WRITERS["realityscan"] = write_realityscan


@pytest.mark.parametrize("name", WRITERS)
def test_a_scene_that_is_not_there(tmp_path, centered, name):
    with pytest.raises((FileNotFoundError, ValueError)) as error:
        load(tmp_path, format=name)
    assert "\n" not in str(error.value)
    WRITERS[name](tmp_path, centered)
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    with pytest.raises(FileNotFoundError):
        load(tmp_path, format=name)
