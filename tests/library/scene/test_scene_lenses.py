"""Lenses that see more than a pinhole: where they put rays, as COLMAP does; pinhole views of their pictures, taken of a
sky that is known in every direction, and what was not seen."""

import dataclasses
import functools
import json

import numpy as np
import pytest
from dataset_writers import write_nerfies
from messages import MESSAGES
from program_writers import write_bundler, write_metashape, write_opensfm, write_realityscan
from refusals import refused
from scene_readers import pixel_centers
from scene_writers import MODEL_NUMBERS, Pictures, spiral_cameras, write_colmap, write_transforms

from warpcage import Camera, load_scene
from warpcage.scene import COEFFICIENTS, distort, undistort, undistorted_intrinsics
from warpcage.scene.formats.colmap import MODELS
from warpcage.scene.lenses import Lens, pinhole_parts

FISHEYE = (0.02, -0.002, 0.0003, 0.00002)


def sky(directions):
    """Colours (..., 3) in [0, 1] of directions in the world."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(unit @ np.array([[3.0, 1, 2], [1, 4, -2], [2, -1, 3]]))


def fisheye_rays(camera, values=FISHEYE):
    """Rays (h, w, 3) of the pixels of a fisheye picture: the polynomial of the angle turned round by a table."""
    x, y = np.moveaxis((pixel_centers(camera) - [camera.cx, camera.cy]) / [camera.fx, camera.fy], -1, 0)
    angles = np.linspace(0, np.pi, 200001)
    bent = angles * (1 + sum(value * angles ** (2 * power) for power, value in enumerate(values, 1)))
    assert (np.diff(bent) > 0).all()
    radius = np.hypot(x, y)
    angle = np.interp(radius, bent, angles)
    across = np.sin(angle) / np.maximum(radius, 1e-12)
    return np.stack([x * across, y * across, np.cos(angle)], axis=-1)


def round_rays(camera):
    """Rays of the pixels of an equirectangular picture."""
    pixels = pixel_centers(camera)
    longitude = (pixels[..., 0] / camera.width - 0.5) * 2 * np.pi
    latitude = (pixels[..., 1] / camera.height - 0.5) * np.pi
    level = np.cos(latitude)
    return np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], axis=-1)


@functools.cache
def sky_pictures(rays, width, height, focal, count=3):
    """Pictures of the sky from several poses; rays: of a camera's pixels."""
    cameras = spiral_cameras(count, width=width, height=height)
    cameras = [Camera(focal, focal, width / 2, height / 2, width, height, c.camera_to_world) for c in cameras]
    colors = np.stack([sky(rays(camera) @ camera.rotation.T) for camera in cameras])
    rgba = np.concatenate([colors * 255, np.full((*colors.shape[:3], 1), 255)], axis=-1)
    return Pictures(rgba.round().astype("u1"), cameras)


def require_sky(scene, pictures, sides, tolerance=0.016, unseen=True):
    """Views look in the directions that their cameras say, from where the pictures were taken."""
    assert scene.alphas is None and len(scene) == len(pictures.cameras) * sides
    weights = np.ones(scene.images.shape[:3], np.float32) if scene.weights is None else scene.weights
    assert np.isin(weights, (0, 1)).all()
    for index, (image, weight, camera) in enumerate(zip(scene.images, weights, scene.cameras, strict=True)):
        written = pictures.cameras[index // sides]
        np.testing.assert_allclose(camera.center, written.center, atol=1e-9)
        local = (pixel_centers(camera) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        rays = np.concatenate([local, np.ones((*local.shape[:2], 1))], axis=-1) @ camera.rotation.T
        error = np.abs(image - sky(rays)).max(axis=-1)
        assert error[weight > 0].max() < tolerance
        assert (image[(weight == 0) & unseen] == 1).all()  # the background
    return weights


def write(folder, pictures, kind, lens, values=()):
    """A scene of a lens, "fisheye" or "round", as each format has it."""
    fisheye = lens == "fisheye"
    named = dict(zip(("k1", "k2", "k3", "k4"), values, strict=False))
    if kind in ("transforms", "is_fisheye"):
        write_transforms(folder, pictures, distortion=named)
        path = folder / "transforms.json"
        content = json.loads(path.read_text()) | {"camera_model": "OPENCV_FISHEYE" if fisheye else "EQUIRECTANGULAR"}
        if kind == "is_fisheye":
            del content["camera_model"]
            content["is_fisheye"] = True
        path.write_text(json.dumps(content))
    elif kind.startswith("colmap"):
        model = "OPENCV_FISHEYE" if fisheye else "EQUIRECTANGULAR"
        write_colmap(folder, pictures, binary=kind == "colmap.bin", model=model, distortion=values)
    elif kind == "opensfm":
        write_opensfm(folder, pictures, kind="fisheye_opencv" if fisheye else "spherical", **named)
    else:  # its polynomial is one of the bent radius, which is the angle: the same
        write_metashape(folder, pictures, sensor="equidistant_fisheye" if fisheye else "spherical", lens=named)


@pytest.mark.parametrize("kind", ["transforms", "is_fisheye", "colmap.txt", "colmap.bin", "opensfm", "metashape"])
def test_a_fisheye_of_90_degrees_becomes_one_view(tmp_path, kind):
    pictures = sky_pictures(fisheye_rays, 96, 72, 60.0)
    write(tmp_path, pictures, kind, "fisheye", FISHEYE)
    scene = load_scene(tmp_path, split="all")
    weights = require_sky(scene, pictures, 1)
    assert weights.mean() > 0.99 and scene.names == pictures.names
    camera = scene.cameras[0]
    assert 0.95 < camera.width * camera.height / (96 * 72) < 1.05
    reach = fisheye_rays(pictures.cameras[0])[36, [0, -1]]  # what the first and last pixel of the middle row see
    seen = np.arctan([camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx])
    np.testing.assert_allclose(seen, np.abs(np.arctan2(reach[:, 0], reach[:, 2])), atol=0.02)


@pytest.mark.parametrize("kind", ["transforms", "colmap.bin", "opensfm", "metashape"])
@pytest.mark.parametrize("downscale", [1, 2])
def test_a_fisheye_of_190_degrees_becomes_five_sides_of_a_cube(tmp_path, kind, downscale):
    pictures = sky_pictures(fisheye_rays, 140, 140, 42.0)
    write(tmp_path, pictures, kind, "fisheye", FISHEYE)
    scene = load_scene(tmp_path, split="all", downscale=downscale)
    weights = require_sky(scene, pictures, 5, tolerance=0.016 * downscale, unseen=downscale == 1)
    assert scene.names[:5] == [f"view_00_{side}" for side in ("front", "right", "left", "up", "down")]
    assert weights[0].min() == 1 and 0.4 < weights[1].mean() < 0.7
    for camera in scene.cameras:
        assert camera.width == camera.height == round(round(42 * np.pi / 2) / downscale)
        assert camera.width / camera.fx == pytest.approx(2.0)
    # a pixel counts where the picture shows it: against the table of the polynomial
    edge = fisheye_rays(pictures.cameras[0])[70, 139]
    limit = np.arctan2(edge[0], edge[2])
    right = scene.cameras[1]
    row, columns = right.height // 2, np.arange(right.width)
    angle = np.pi / 2 + np.arctan((columns + 0.5 - right.cx) / right.fx)
    clear = np.abs(angle - limit) > 0.04 * downscale
    np.testing.assert_array_equal(weights[1, row][clear], (angle < limit)[clear])


@pytest.mark.parametrize("kind", ["transforms", "colmap.txt", "colmap.bin", "opensfm", "metashape"])
def test_an_equirectangular_picture_becomes_a_cube(tmp_path, kind):
    pictures = sky_pictures(round_rays, 160, 80, 30.0)
    write(tmp_path, pictures, kind, "round")
    scene = load_scene(tmp_path, split="all")
    require_sky(scene, pictures, 6)
    assert scene.weights is None and scene.cameras[0].width == 40
    sides = np.stack([camera.rotation[:, 2] for camera in scene.cameras[:6]])
    np.testing.assert_allclose(np.abs(sides @ sides.T - np.eye(6)).max(axis=1), 1, atol=1e-9)  # the opposite one


def test_sides_of_one_picture_are_in_one_split(tmp_path):
    pictures = sky_pictures(round_rays, 32, 16, 5.0, count=9)
    write_colmap(tmp_path, pictures, binary=True, model="EQUIRECTANGULAR")
    names = {split: {name[:7] for name in load_scene(tmp_path, split=split).names} for split in ("train", "test")}
    assert names["test"] == {"view_00", "view_08"} and len(names["train"]) == 7


def test_masks_are_resampled_with_their_pictures(tmp_path):
    pictures = sky_pictures(fisheye_rays, 140, 140, 42.0)
    pictures = dataclasses.replace(pictures, rgba=pictures.rgba.copy())
    pictures.rgba[:, :, 70:, 3] = 0
    write_colmap(tmp_path, pictures, binary=True, model="OPENCV_FISHEYE", distortion=FISHEYE, masks=True)
    scene = load_scene(tmp_path, split="all")
    assert scene.alphas[0, :, :31].min() > 0.99 and scene.alphas[0, :, 35:].max() < 0.01
    assert scene.weights[0].min() == 1 and load_scene(tmp_path, masks=False).alphas is None


def test_metashape_coefficients_that_opencv_has_not(tmp_path):
    """k4, p3, p4 and the skew b2, by the formula of its manual."""
    lens = {"k1": -0.05, "k2": 0.01, "k3": 0.002, "k4": 0.003, "p1": 0.004, "p2": -0.003, "p3": 0.1, "p4": 0.02}
    lens["b2"] = 0.7

    def seen(camera):
        target = (pixel_centers(camera) - [camera.cx, camera.cy]) / camera.fy
        place = target.copy()
        for _ in range(100):
            x, y = np.moveaxis(place, -1, 0)
            s = x * x + y * y
            radial = 1 + lens["k1"] * s + lens["k2"] * s**2 + lens["k3"] * s**3 + lens["k4"] * s**4
            more = 1 + lens["p3"] * s + lens["p4"] * s**2
            a = x * radial + (lens["p1"] * (s + 2 * x * x) + 2 * lens["p2"] * x * y) * more
            b = y * radial + (lens["p2"] * (s + 2 * y * y) + 2 * lens["p1"] * x * y) * more
            place += target - np.stack([a + b * lens["b2"] / camera.fy, b], axis=-1)
        return np.concatenate([place, np.ones((*place.shape[:2], 1))], axis=-1)

    pictures = sky_pictures(seen, 96, 72, 80.0)
    write_metashape(tmp_path, pictures, lens=lens)
    require_sky(load_scene(tmp_path, split="all"), pictures, 1)


#: OpenSfM's lenses; p1 and p2 are its own, which are OpenCV's p1 and p2.
OPENSFM = {
    "fisheye62": {
        "k1": 0.02,
        "k2": -0.01,
        "k3": 0.003,
        "k4": 0.001,
        "k5": -2e-4,
        "k6": 1e-4,
        "p1": 0.004,
        "p2": -0.006,
    },
    "dual": {"transition": 0.6, "k1": -0.03, "k2": 0.008},
}
OPENSFM["fisheye624"] = {**OPENSFM["fisheye62"], "s0": 0.006, "s1": -0.003, "s2": -0.005, "s3": 0.002}


@pytest.mark.parametrize("kind", OPENSFM)
def test_opensfm_lenses_that_opencv_has_not(tmp_path, kind):
    """By the formulas of its page on geometry (and of its source, for the dual lens and thin prisms)."""
    given = dict.fromkeys(("p1", "p2", "s0", "s1", "s2", "s3", "transition"), 0.0) | OPENSFM[kind]

    def bent(x, y):
        """Where a place of the fisheye projection, or of the mix, comes to be."""
        s = x * x + y * y
        radial = 1 + sum(given.get(f"k{power}", 0.0) * s**power for power in range(1, 7))
        a = x * radial + 2 * given["p1"] * x * y + given["p2"] * (s + 2 * x * x) + given["s0"] * s + given["s1"] * s * s
        b = y * radial + 2 * given["p2"] * x * y + given["p1"] * (s + 2 * y * y) + given["s2"] * s + given["s3"] * s * s
        return np.stack([a, b], axis=-1)

    def seen(camera):
        target = (pixel_centers(camera) - [camera.cx, camera.cy]) / camera.fx
        place = target.copy()
        for _ in range(200):
            place += target - bent(*np.moveaxis(place, -1, 0))
        radius = np.maximum(np.hypot(*np.moveaxis(place, -1, 0)), 1e-12)
        angles = np.linspace(0, 1.4, 200001)
        mixed = given["transition"] * np.tan(angles) + (1 - given["transition"]) * angles
        angle = np.interp(radius, mixed, angles)
        return np.concatenate([place * (np.sin(angle) / radius)[..., None], np.cos(angle)[..., None]], axis=-1)

    pictures = sky_pictures(seen, 96, 72, 80.0)
    write_opensfm(tmp_path, pictures, kind=kind, **OPENSFM[kind])
    require_sky(load_scene(tmp_path, split="all"), pictures, 1)


def test_one_view_has_no_pixel_that_was_not_seen_in_the_middle_of_its_edges(tmp_path):
    for name, values, focal in (("FISHEYE", FISHEYE, 60.0), ("FOV", (0.6,), 80.0), ("DIVISION", (-0.1,), 80.0)):
        lens = Lens(name, values)
        intrinsics = (focal, focal * 1.1, 40.0, 38.0)
        (part,) = pinhole_parts(lens, intrinsics, (96, 72), "here")
        middle = [part.intrinsics[2:], (0.5, part.intrinsics[3]), (part.intrinsics[2], part.size[1] - 0.5)]
        for u, v in middle:
            assert lens.pixels(part.rays(np.array([u]), np.array([v])), intrinsics, (96, 72))[2].all()


# Damaged ones


@pytest.mark.parametrize("model", [18, 4711, -1])
def test_models_of_new_numbers_are_told(tmp_path, model):
    pictures = sky_pictures(round_rays, 32, 16, 5.0)
    write_colmap(tmp_path, pictures, binary=True)
    path = tmp_path / "sparse" / "0" / "cameras.bin"
    data = path.read_bytes()
    path.write_bytes(data[:12] + np.int32(model).tobytes() + data[16:])
    refused(lambda: load_scene(tmp_path), match=MESSAGES["scene.model_number"].format(number=model))


@pytest.mark.parametrize(
    "values, said",
    [((-1e9, 0, 0, 0), "sees nothing"), ((1e-3, 1e300, 0, 0), "sees nothing|become"), ((0, 0, 0, -0.9), "test")],
)
def test_lenses_that_fold_at_once_are_refused_or_cut(tmp_path, values, said):
    pictures = sky_pictures(fisheye_rays, 96, 72, 60.0)
    write(tmp_path, pictures, "colmap.txt", "fisheye", values)
    if said != "test":
        refused(lambda: load_scene(tmp_path), match=f"image 'view_0.*({said})")
    else:
        assert Lens("FISHEYE", values).reach < 1.0
        assert len(load_scene(tmp_path)) == 2


# As COLMAP has it


def test_numbers_and_parameters_are_those_of_colmap():
    pycolmap = pytest.importorskip("pycolmap")
    theirs = {int(number): name for name, number in pycolmap.CameraModelId.__members__.items() if int(number) >= 0}
    assert {number: model.name for number, model in enumerate(MODELS)} == theirs
    for number, model in enumerate(MODELS):
        camera = pycolmap.Camera.create_from_model_name(1, model.name, 50.0, 64, 48)
        assert len(camera.params) == len(model.parameters), number


VALUES = {
    "OPENCV_FISHEYE": FISHEYE, "FOV": (0.6,), "SIMPLE_RADIAL_FISHEYE": (0.03,), "RADIAL_FISHEYE": (0.03, -0.004),
    "THIN_PRISM_FISHEYE": (0.02, -0.003, 0.004, -0.002, 0.001, 0.0005, 0.003, -0.004),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.02, -3e-3, 1e-3, 5e-4, -2e-4, 1e-4, 4e-3, -2e-3, 3e-3, 1e-3, -2e-3, 4e-4),
    "SIMPLE_DIVISION": (-0.08,), "DIVISION": (0.05,), "SIMPLE_FISHEYE": (), "FISHEYE": (), "EUCM": (0.6, 1.1),
    "EQUIRECTANGULAR": (),
}  # fmt: skip


@pytest.mark.parametrize("name", [model.name for model in MODELS if model.lens])
def test_lenses_put_rays_where_colmap_does(name):
    pycolmap = pytest.importorskip("pycolmap")
    model = next(model for model in MODELS if model.name == name)
    intrinsics = (50.0, 50.0 if "f" in model.parameters else 52.0, 33.0, 23.0)
    if name == "EQUIRECTANGULAR":
        parameters, intrinsics = (64, 48), (64 / (2 * np.pi), 48 / np.pi, 32, 24)
    else:
        parameters = (*intrinsics[intrinsics[0] == intrinsics[1] :], *VALUES[name])
    camera = pycolmap.Camera(model=name, width=64, height=48, params=parameters)
    lens = Lens(model.lens, VALUES[name])
    rays = np.random.default_rng(0).normal(size=(200, 3))
    rays = rays[np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) < min(lens.reach, np.radians(85))]
    if name != "EQUIRECTANGULAR":
        rays = rays[rays[:, 2] > 0]
    a, b = lens.project(rays)
    found = np.stack([a * intrinsics[0] + intrinsics[2], b * intrinsics[1] + intrinsics[3]], axis=1)
    expected = [camera.img_from_cam(ray) for ray in rays]
    assert len(rays) > 40 and all(pixel is not None for pixel in expected)
    np.testing.assert_allclose(found, np.reshape(expected, (-1, 2)), atol=1e-9)


# Lenses that bend a pinhole's picture

LENSES = {
    "barrel": (-0.12, 0.02),
    "pincushion": (0.1, 0.01),
    "tangential": (0.0, 0.0, 0.01, -0.008),
    "all": (-0.1, 0.03, 0.004, -0.006),
    "rational": (0.05, 0.01, 0.002, 0.001, 0.01, 0.02, 0.01, 0.005),
    "one": (-0.12,),
}


def picture_of(camera, pixels):
    """A smooth picture on the sky, looked up along the rays through pixels (h, w, 2) of a pinhole camera."""
    local = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    world = np.concatenate([local, np.ones((*pixels.shape[:2], 1))], axis=-1) @ camera.rotation.T
    world /= np.linalg.norm(world, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(world @ np.array([[3.0, 1, 2], [1, 4, -2], [2, -1, 3]]))


def seen_through(camera, coefficients):
    """The same sky through a lens: its pixels traced back to the pinhole by fixed-point iteration."""
    pixels = pixel_centers(camera)
    target = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    pinhole = target.copy()
    for _ in range(200):
        bent = np.stack(distort(pinhole[..., 0], pinhole[..., 1], coefficients), axis=-1)
        pinhole += target - bent
    assert np.abs(bent - target).max() < 1e-9
    return picture_of(camera, pinhole * [camera.fx, camera.fy] + [camera.cx, camera.cy])


@functools.cache
def lens_pictures(lens, focals, middle=False):
    """Four pictures of the sky through a lens; middle: whether its axis meets the middle of the picture."""
    cameras, place = spiral_cameras(4, width=64, height=48), (32.0, 24.0) if middle else (33.0, 23.0)
    cameras = [Camera(50.0, focals[-1], *place, 64, 48, c.camera_to_world) for c in cameras]
    images = np.stack([seen_through(camera, LENSES[lens]) for camera in cameras])
    rgba = np.concatenate([np.round(images * 255), np.full((4, 48, 64, 1), 255)], axis=-1).astype(np.uint8)
    return Pictures(rgba, cameras)


def lens_scenes():
    """Name, lens, writer, focal lengths, and whether the lens must meet the middle of the picture."""
    with_options, named = functools.partial, ("k1", "k2", "p1", "p2")
    one, two = (50.0,), (50.0, 52.0)
    for lens in ("barrel", "pincushion", "tangential", "all"):
        given = dict(zip(named, LENSES[lens], strict=False))
        yield "transforms", lens, with_options(write_transforms, shared=False, distortion=given), two, False
    for model, lens, binary in (
        ("SIMPLE_RADIAL", "one", False),
        ("RADIAL", "barrel", True),
        ("OPENCV", "all", False),
        ("OPENCV", "all", True),
        ("FULL_OPENCV", "rational", False),
        ("FULL_OPENCV", "rational", True),
    ):
        write = with_options(write_colmap, binary=binary, model=model, distortion=LENSES[lens])
        yield f"colmap {model} {binary}", lens, write, one if "RADIAL" in model else two, False
    yield "bundler", "barrel", with_options(write_bundler, distortion=LENSES["barrel"]), one, True
    for lens in ("barrel", "tangential", "all"):
        k1, k2, t1, t2 = (*LENSES[lens], 0.0, 0.0)[:4]
        yield "realityscan", lens, with_options(write_realityscan, lens=(k1, k2, 0.0, 0.0, t1, t2)), one, False
    for kind, lens in (("perspective", "barrel"), ("brown", "all")):
        given, single = dict(zip(named, LENSES[lens], strict=False)), kind == "perspective"
        yield f"opensfm {kind}", lens, with_options(write_opensfm, kind=kind, **given), one if single else two, single
    k1, k2, p1, p2 = LENSES["all"]
    given = {"k1": k1, "k2": k2, "p1": p2, "p2": p1}  # in the order of its manual
    yield "metashape", "all", with_options(write_metashape, lens=given), two, False
    yield "nerfies", "all", with_options(write_nerfies, lens=(k1, k2, 0.0, p1, p2), held=(0,)), two, False


LENS_SCENES = {f"{name} {lens}": (lens, *rest) for name, lens, *rest in lens_scenes()}


@pytest.mark.parametrize("name", LENS_SCENES)
def test_lenses_are_undone(tmp_path, name):
    lens, write, focals, middle = LENS_SCENES[name]
    pictures = lens_pictures(lens, focals, middle)
    write(tmp_path, pictures)
    scene = load_scene(tmp_path)
    assert scene.alphas is None and len(scene) == 3
    for image, read, written in zip(scene.images, scene.cameras, pictures.cameras[1:], strict=True):
        zoom = read.fx / written.fx
        assert 1.0 <= zoom < 1.1 and read.fy / written.fy == pytest.approx(zoom)
        assert (read.cx, read.cy) == (written.cx, written.cy)
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        error = np.abs(image - picture_of(read, pixel_centers(read)))
        assert error[1:-1, 1:-1].max() < 0.008 and error.max() < 0.015  # half a pixel at the edge is repeated


@pytest.mark.parametrize("lens", ["barrel", "tangential", "all"])
def test_realityscan_lenses_of_four_radial_coefficients(tmp_path, lens):
    """They are resampled in another way; with next to nothing as the fourth, to the same pictures."""
    pictures = lens_pictures(lens, (50.0,))
    k1, k2, t1, t2 = (*LENSES[lens], 0.0, 0.0)[:4]
    write_realityscan(tmp_path, pictures, lens=(k1, k2, 0.0, 1e-9, t1, t2))
    scene = load_scene(tmp_path)
    for image, read, written in zip(scene.images, scene.cameras, pictures.cameras[1:], strict=True):
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        error = np.abs(image - picture_of(read, pixel_centers(read)))[2:-2, 2:-2]
        assert read.width > 40 and error.max() < 0.01


def test_an_undistorted_picture_of_a_lens_without_distortion_is_itself():
    image = np.random.default_rng(0).random((7, 9, 4), dtype=np.float32)
    intrinsics = (10.0, 11.0, 4.0, 3.6)
    assert undistorted_intrinsics(intrinsics, (9, 7), (0.0,) * 4, "here") == intrinsics
    np.testing.assert_allclose(undistort(image, intrinsics, intrinsics, (0.0,) * 4), image, atol=1e-6)


@pytest.mark.parametrize("k1", [1e6, -50.0, 1e300])
def test_a_lens_that_folds_the_picture_is_refused(k1):
    with pytest.raises(ValueError, match="here: lens distortion k1="):
        undistorted_intrinsics((10.0, 10.0, 5.0, 5.0), (10, 10), (k1,), "here")


@pytest.mark.parametrize(
    "model, lens", [("OPENCV", "all"), ("FULL_OPENCV", "rational"), ("RADIAL", "barrel"), ("SIMPLE_RADIAL", "one")]
)
def test_distortion_is_that_of_colmap(model, lens):
    pycolmap = pytest.importorskip("pycolmap")
    focal = [50.0] if "RADIAL" in model else [50.0, 52.0]
    camera = pycolmap.Camera(model=model, width=64, height=48, params=[*focal, 33.0, 23.0, *LENSES[lens]])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    pixels = np.array([camera.img_from_cam(np.array([x, y, 1.0])) for x, y in points]).reshape(-1, 2)
    expected = np.stack(distort(*points.T, LENSES[lens]), axis=-1) * [focal[0], focal[-1]] + [33.0, 23.0]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_lens_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) * [1, 1, 0] + [0, 0, 1]
    for lens in LENSES.values():
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array((lens + (0.0,) * 8)[:8]))
        np.testing.assert_allclose(pixels[:, 0], np.stack(distort(*points.T[:2], lens), axis=-1), atol=1e-9)
    assert len(COEFFICIENTS) == 8 and len(MODEL_NUMBERS) == 8
