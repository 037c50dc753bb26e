"""Pictures of the editor: what is sent of a frame, bands, efforts, and the thread that renders the newest document."""

import contextlib
import dataclasses
import json
import struct
import threading

import numpy as np
import pytest
import warp as wp
from fields import INSIDE, NUB, PART, boxes, make_field, plain, shiny_field, surrounded_ball

import warpcage
from warpcage import Cage, Frame
from warpcage.studio.editor import (
    COARSE_CELLS,
    FRAME,
    MIN_SIDE,
    Pace,
    Renderer,
    Request,
    View,
    band_camera,
    depth_size,
    frame_pixels,
    joined_pixels,
    new_document,
    packed_frame,
    same_pose,
    view_camera,
)

simplejpeg = pytest.importorskip("simplejpeg")

NEAR, FAR = 0.5, 8.0
BOX = Cage.box([-0.6, -0.6, -0.6], [0.6, 0.6, 0.6])


@pytest.fixture
def frame(device):
    """37 x 23 pixels with colours beyond [0, 1], depths that are infinite, and faint pixels."""
    rng = np.random.default_rng(3)
    count = 37 * 23
    depth = rng.uniform(0.1, 12.0, count).astype(np.float32)
    depth[::7] = np.inf
    arrays = {"rgb": rng.uniform(-0.2, 1.2, (count, 3)), "alpha": rng.uniform(0.0, 1.0, count), "depth": depth}
    kinds = {"rgb": wp.vec3, "alpha": wp.float32, "depth": wp.float32}
    held = {name: wp.array(values, dtype=kinds[name], device=device) for name, values in arrays.items()}
    return Frame(37, 23, **held)


def test_colors_are_rounded_to_bytes(frame):
    pixels = frame_pixels(frame, "rgb", NEAR, FAR, 8, 6)
    expected = np.floor(np.clip(frame.rgb, 0.0, 1.0) * 255.0 + 0.5)
    assert pixels.colors.dtype == np.uint8 and pixels.colors.shape == (23, 37, 3)
    np.testing.assert_array_equal(pixels.colors, expected)


@pytest.mark.parametrize("depths", [5, 16, 37, 64])
def test_depths_are_those_of_pixels_and_come_back(frame, depths):
    columns, rows = depth_size(37, 23, depths)
    pixels = frame_pixels(frame, "rgb", NEAR, FAR, columns, rows)
    assert (
        pixels.depths.shape == (rows, columns)
        and max(rows, columns) == min(depths, 37)
        and abs(rows / columns - 23 / 37) < 0.7 / columns
    )
    middles = [[(2 * k + 1) * size // (2 * parts) for k in range(parts)] for size, parts in ((23, rows), (37, columns))]
    at = np.ix_(*middles)
    depth, alpha = frame.depth[at], frame.alpha[at]
    seen = np.isfinite(depth) & (alpha >= 0.5)
    np.testing.assert_array_equal(pixels.depths > 0, seen)
    back = NEAR * (FAR / NEAR) ** ((pixels.depths[seen] - 1.0) / 65534.0)
    np.testing.assert_allclose(back, np.clip(depth[seen], NEAR, FAR), rtol=1e-4)


def test_other_parts_of_a_frame_are_shown(frame):
    disparity, alpha = (frame_pixels(frame, show, NEAR, FAR, 8, 6).colors for show in ("disparity", "alpha"))
    assert disparity.shape == alpha.shape == (23, 37, 3)
    np.testing.assert_array_equal(alpha[..., 0], np.floor(frame.alpha * 255.0 + 0.5))
    assert (
        frame_pixels(frame, "masks", NEAR, FAR, 8, 6).colors == frame_pixels(frame, "rgb", NEAR, FAR, 8, 6).colors
    ).all()


def test_bands_make_the_whole_picture(device):
    field = shiny_field(device, resolution=24)
    view = new_document(field).view
    whole = view_camera(view, 30, 22)
    parts = [field.render(band_camera(whole, first, min(first + 5, 22))) for first in range(0, 22, 5)]
    joined = joined_pixels([frame_pixels(part, "rgb", NEAR, FAR, 8, 6) for part in parts])
    np.testing.assert_array_equal(joined.colors, frame_pixels(field.render(whole), "rgb", NEAR, FAR, 8, 6).colors)


@pytest.mark.parametrize("quality", [60, 95])
def test_messages_hold_header_jpeg_and_depths(frame, quality):
    pixels = frame_pixels(frame, "alpha", NEAR, FAR, 9, 6)
    message = packed_frame({"frame": 3, "text": "Grüße"}, pixels, quality)
    kind, text, jpeg, depths = struct.unpack_from("<4I", message)
    assert kind == FRAME
    assert json.loads(message[16 : 16 + text]) == {"frame": 3, "text": "Grüße"}
    begin = 16 + text + (-text) % 8
    assert begin % 8 == 0
    decoded = simplejpeg.decode_jpeg(message[begin : begin + jpeg])
    assert decoded.shape == pixels.colors.shape
    assert (depths, message[len(message) - depths :]) == (pixels.depths.nbytes, pixels.depths.tobytes())
    assert (len(message) - depths) % 8 == 0


def test_numbers_that_json_lacks_are_refused():
    with pytest.raises(ValueError):
        packed_frame({"frame": float("nan")}, None, 0)


# -- Efforts


def learned(pixel=1e-6, pose=None):
    pace = Pace(cuda=False)
    effort = pace.moving(1000, 500, 64, "harmonic", True)
    for _ in range(40):
        pace.learn(effort, "harmonic", None, pixel * effort.width * effort.height)
    for cells, seconds in (pose or {}).items():
        pace.learn(dataclasses.replace(effort, cells=cells), "harmonic", seconds, pixel * effort.width * effort.height)
    return pace


def test_quick_pixels_are_many_and_slow_ones_few():
    sizes = [learned(pixel).moving(1000, 500, 64, "harmonic", False).width for pixel in (1e-9, 1e-7, 1e-6, 1e-3)]
    assert sizes[0] == 1000 and sizes[-1] == MIN_SIDE
    assert sizes == sorted(sizes, reverse=True)


def test_lattices_are_as_fine_as_there_is_time():
    cells = [
        learned(pose={24: seconds}).moving(400, 400, 64, "harmonic", True).cells for seconds in (1e-4, 0.012, 0.1, 10.0)
    ]
    assert cells == sorted(cells, reverse=True) and cells[0] == 64 and cells[-1] == COARSE_CELLS[0]
    assert learned(pose={24: 10.0}).moving(400, 400, 12, "harmonic", True).cells == 12  # never finer than asked for


def test_sizes_do_not_flicker():
    pace = learned(1e-6)
    first = pace.moving(1000, 500, 16, "harmonic", False)
    for pixel in (0.95e-6, 1.06e-6, 0.97e-6):
        pace.learn(first, "harmonic", None, pixel * first.width * first.height)
        assert pace.moving(1000, 500, 16, "harmonic", False).width == first.width


def test_a_gpu_keeps_the_lattice():
    assert Pace(cuda=True).moving(800, 800, 128, "harmonic", True).cells == 128


# -- The renderer


class Shown:
    """What a renderer delivered."""

    def __init__(self):
        self.headers, self.messages = [], []
        self.news = threading.Condition()

    def __call__(self, header, message):
        with self.news:
            self.headers.append(header)
            self.messages.append(message)
            self.news.notify_all()

    def wait(self, condition):
        with self.news:
            assert self.news.wait_for(lambda: any(map(condition, self.headers)), 120)
            return next(header for header in self.headers if condition(header))

    def picture(self, header):
        """What was delivered with a header, decoded."""
        message = self.messages[self.headers.index(header)]
        _, text, jpeg, _ = struct.unpack_from("<4I", message)
        begin = 16 + text + (-text) % 8
        return simplejpeg.decode_jpeg(message[begin : begin + jpeg]) / 255.0


@contextlib.contextmanager
def rendering(field):
    """A renderer of a field, and what it delivers."""
    shown = Shown()
    renderer = Renderer(field, shown)
    try:
        yield renderer, shown
    finally:
        renderer.close()


@pytest.fixture
def document(device):
    field = shiny_field(device, resolution=24)
    low, high = field.bounds
    size = high - low
    return field, new_document(field, [warpcage.Cage.box(low - 0.05 * size, high + 0.05 * size)], 16)


def request(document, moving=False, number=0):
    return Request(document, 48, 32, moving, {1: number})


def bent(document, degrees):
    edit = document.edits[0]
    return document.with_edit(dataclasses.replace(edit, posed=edit.rest_cage.bend(degrees).vertices))


def test_a_sharp_picture_is_the_frame_of_the_settings(document):
    field, scene = document
    posed = bent(scene, 30.0)
    with rendering(field) as (renderer, shown):
        renderer.request(request(posed, number=7))
        header = shown.wait(lambda header: header["sharp"])
    assert (header["width"], header["height"], header["applied"]) == (48, 32, {"1": 7})
    picture = shown.picture(header)
    edit = posed.edits[0]
    deformer = warpcage.Deformer(field, edit.rest_cage, resolution=16).pose(edit.posed_cage)
    assert warpcage.psnr(picture, deformer.render(view_camera(posed.view, 48, 32)).rgb) > 33.0
    assert set(header["masks"]) == {"fold", "reveal", "outside"}


def test_a_pose_that_cannot_be_used_is_reported_and_the_next_one_shown(document):
    field, scene = document
    edit = scene.edits[0]
    flat = scene.with_edit(dataclasses.replace(edit, posed=edit.rest * [1.0, 1.0, 0.0]))
    with rendering(field) as (renderer, shown):
        renderer.request(request(flat, number=1))
        complaint = shown.wait(lambda header: header["error"])
        assert "\n" not in complaint["error"] and complaint["applied"] == {"1": 1}
        renderer.request(request(scene, number=2))
        shown.wait(lambda header: header["sharp"] and header["applied"] == {"1": 2})


def test_what_a_pose_hangs_on(document):
    _, scene = document
    edit = scene.edits[0]
    assert same_pose(scene, dataclasses.replace(scene, view=dataclasses.replace(scene.view, fov=20.0)))
    for other in (
        bent(scene, 5.0),
        scene.with_edit(dataclasses.replace(edit, visible=False)),
        scene.with_edit(dataclasses.replace(edit, kind="copy")),
        dataclasses.replace(scene, edits=()),
        dataclasses.replace(scene, settings=dataclasses.replace(scene.settings, coordinates="green")),
    ):
        assert not same_pose(scene, other)


@pytest.mark.parametrize("seconds", [0.0, 0.2, 1e3])
def test_depths_of_a_sharp_picture_are_as_many_in_bands_as_in_one(document, seconds):
    """A page takes them for those of one picture, whatever bands a slow CPU has cut it in."""
    field, scene = document
    wanted = Request(scene, 300, 220, False, {1: 1})
    with rendering(field) as (renderer, shown):
        renderer.pace.sharp_seconds = lambda effort, coordinates: seconds  # bands are cut by what it is thought to take
        renderer.request(wanted)
        header = shown.wait(lambda header: header["sharp"])
    columns, rows = depth_size(300, 220, 256)
    assert (header["depth"]["width"], header["depth"]["height"]) == (columns, rows)
    message = shown.messages[shown.headers.index(header)]
    depths = np.frombuffer(message[-2 * rows * columns :], "<u2").reshape(rows, columns)
    whole = frame_pixels(field.render(view_camera(scene.view, 150, 110)), "rgb", 1.0, 9.0, columns, rows)
    assert np.mean((depths > 0) == (whole.depths > 0)) > 0.98  # bands round their rows by themselves


def sharp(field, document, **settings):
    """Header and decoded picture of a sharp picture."""
    with rendering(field) as (renderer, shown):
        changed = dataclasses.replace(document, settings=dataclasses.replace(document.settings, **settings))
        renderer.request(Request(changed, 48, 48, False, {}))
        header = shown.wait(lambda header: header["error"] or header["sharp"])
    assert not header["error"], header["error"]
    return header, shown.picture(header)


def test_a_fade_without_a_wall_is_reported(device):
    field = make_field(boxes(INSIDE, NUB), plain([0.8, 0.3, 0.1]), device=device)
    scene, whole = new_document(field, [PART], 16), PART.scale(2.4)
    edit = dataclasses.replace(scene.edits[0], falloff=0.2, rest=whole.vertices, posed=whole.vertices)
    with rendering(field) as (renderer, shown):
        renderer.request(Request(scene.with_edit(edit), 48, 48, False, {}))
        error = shown.wait(lambda header: header["error"])["error"]
    assert "has a fade, but no side of its cage cuts through" in error and repr(edit.name) in error


@pytest.mark.parametrize("around", ["layers", "outer"])
def test_background_is_filled_in_pictures_that_rest(device, around):
    field = surrounded_ball(device, around)
    scene = new_document(field, [BOX], 16)
    scene = scene.with_edit(dataclasses.replace(scene.edits[0], kind="remove"))
    scene = dataclasses.replace(scene, view=View((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    plain_header, plain_picture = sharp(field, scene)
    header, picture = sharp(field, scene, fill=True)
    looking = view_camera(scene.view, 48, 48)
    frame = warpcage.Deformer(field, scene.edits[0].cage_edit, resolution=16).render(looking)
    filled = warpcage.fill_unseen(frame, field, looking)
    assert filled.filled.max() > 0.9
    assert warpcage.psnr(picture, np.clip(filled.rgb, 0, 1)) > 33.0
    assert np.abs(np.clip(filled.rgb, 0, 1) - plain_picture).max() > 0.1
    assert "filled" not in plain_header["masks"] and header["masks"]["filled"] > 0.01
    _, masks = sharp(field, scene, fill=True, show="masks")
    violet = np.abs(masks - [0.6, 0.25, 0.85]).sum(axis=-1) < 0.5
    assert violet.sum() > 20
    header, _ = sharp(field, scene, fill=True, background="white")  # nothing is missing there
    assert "filled" not in header["masks"]
