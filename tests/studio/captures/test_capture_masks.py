"""Captures with masks, and of what turns before a wall that stands still: cameras against the true ones."""

import json

import numpy as np
import pytest
from ground_truth import TEXTURE, CarriedMesh
from PIL import Image
from refusals import refused
from scenes import camera_errors, found_poses, save_pictures
from test_capture_video import moving_pictures, write_video

import warpcage
from warpcage import Cage, Camera
from warpcage.studio.captures import FrameScores, pick_frames, still_features
from warpcage.studio.captures.feature_masks import masks_of, write_feature_masks
from warpcage.studio.captures.sources import read_sources
from warpcage.studio.captures.video import shrink_all

pytest.importorskip("pycolmap", minversion="4.2")

#: Pictures of the turntable, degrees from one to the next, and their width and height.
COUNT, STEP, SIZE = 15, 12.0, (320, 240)


def turning_pictures():
    """Pictures (n, h, w, 3) uint8 of a tower of patches on a plate that turns before a wall of coloured spots, its
    outlines (n, h, w), and the cameras as the tower sees them."""
    rng = np.random.default_rng(7)
    boxes = ((-1.2, -1.2, -0.9), (1.2, 1.2, -0.75), 9), ((-0.6, -0.5, -0.75), (0.6, 0.5, 0.3), 7)
    parts = [Cage.box(low, high, segments=n) for low, high, n in (*boxes, ((-0.3, -0.3, 0.3), (0.35, 0.3, 0.95), 5))]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    colors = rng.uniform(0.1, 0.95, (len(faces), 3))
    angles = np.radians(STEP) * np.arange(COUNT)
    eyes = np.stack([3.2 * np.sin(angles), -3.2 * np.cos(angles), np.full(COUNT, 1.4)], axis=1)
    cameras = [Camera.look_at(eye, (0, 0, 0), fov_degrees=52, width=SIZE[0], height=SIZE[1]) for eye in eyes]
    tower = CarriedMesh(np.concatenate([part.vertices for part in parts]), faces, colors, texture=TEXTURE, device="cpu")
    rgba, _ = tower.render(cameras, samples=2)
    spots = Image.fromarray(rng.integers(0, 256, (SIZE[1] // 6, SIZE[0] // 6, 3), dtype=np.uint8))
    wall = np.asarray(spots.resize(SIZE, Image.Resampling.BICUBIC)) / 255.0
    pictures = rgba[..., :3] * rgba[..., 3:] + (1.0 - rgba[..., 3:]) * wall
    pictures = np.clip(pictures + rng.normal(scale=0.01, size=pictures.shape), 0, 1)  # no two of the wall are the same
    return np.rint(255 * pictures).astype(np.uint8), np.rint(255 * rgba[..., 3]).astype(np.uint8), cameras


@pytest.fixture(scope="module")
def turning():
    return turning_pictures()


def save_masks(folder, masks, naming="p{:03d}.png"):
    folder.mkdir(parents=True, exist_ok=True)
    for index, mask in enumerate(masks):
        Image.fromarray(mask).save(folder / naming.format(index))
    return folder


def assert_cameras(folder, cameras):
    names, poses, _ = found_poses(folder)
    assert len(names) == len(cameras)
    true = [cameras[int(name[1:])] for name in names]
    turns, off = camera_errors(poses, true)
    assert np.median(turns) < 1.0 and np.median(off) < 0.01, (turns, off)


@pytest.mark.nightly
def test_a_turntable_before_a_wall(tmp_path, turning):
    """Features of the wall, which are more than a third, do not count."""
    pictures, _, cameras = turning
    folder = save_pictures(tmp_path / "in", pictures)
    report = warpcage.capture(folder, tmp_path / "out", turntable=True, progress=False)
    assert_cameras(tmp_path / "out", cameras)
    assert 0.2 < report.facts["share_of_features_that_stand_still"] < 0.6
    assert any("write masks/NAME.png" in sentence for sentence in report.advice)
    assert "share of features that stand still" in (tmp_path / "out" / "capture.md").read_text()


def test_masks_take_the_wall_away_and_go_with_the_scene(tmp_path, turning):
    """masks/ beside the pictures without a word; the scene's masks are those of its undistorted pictures."""
    pictures, masks, cameras = turning
    folder = save_pictures(tmp_path / "pictures", pictures, ending=".jpg")
    save_masks(tmp_path / "masks", masks, "p{:03d}.jpg.png")
    report = warpcage.capture(folder, tmp_path / "out", progress=False)
    assert_cameras(tmp_path / "out", cameras)
    assert report.facts["share_of_pixels_that_count"] == pytest.approx((masks > 127).mean(), abs=0.01)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame["mask_path"] for frame in frames] == [f"masks/p{k:03d}.png" for k in range(COUNT)]
    scene = warpcage.load_scene(tmp_path / "out", split="all")
    assert scene.captured and np.abs(scene.alphas - masks / 255.0).mean() < 0.02


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ("nowhere", "are not there: give a folder"),
        ("in/p000.npy", "one picture for all, this looks like"),
        ("other", r"has the name of a picture: p000.png or"),
        ("small", "is 9x9, its picture 'p000.png' 320x240"),
        ("black.png", "in what masks leave of them, 0 features"),
    ],
)
def test_masks_that_are_refused(tmp_path, turning, masks, message):
    folder = save_pictures(tmp_path / "in", turning[0][:3])
    (folder / "p000.npy").write_bytes(b"")
    save_masks(tmp_path / "other", [turning[1][0]], "x{}.png")
    save_masks(tmp_path / "small", np.zeros((3, 9, 9), np.uint8))
    Image.new("L", SIZE).save(tmp_path / "black.png")
    options = {"output": tmp_path / "out", "masks": tmp_path / masks, "progress": False}
    refused(lambda: warpcage.capture(folder, **options), match=message, error=(ValueError, FileNotFoundError))
    assert not (tmp_path / "out").exists()


def test_opacity_and_what_is_to_be_ignored_hide_features(tmp_path):
    """Of the pictures' own alpha, of dynamic_mask_NAME.png, which is no picture, and of a mask that lies on its side as
    its picture does."""
    folder, rng = tmp_path / "in", np.random.default_rng(0)
    rgba = rng.integers(0, 256, (3, 40, 60, 4), dtype=np.uint8)
    rgba[0, :, :, 3], rgba[0, :, :20, 3] = 255, 0
    save_pictures(folder, [rgba[0]])
    save_pictures(folder, [rgba[1, ..., :3]], first=1, ending=".jpg", orientation=6)
    save_pictures(folder, [rgba[2, ..., :3]], first=2)
    lying = np.zeros((40, 60), np.uint8)
    lying[:, :15] = 255  # of the picture's left side, which is on top once it is upright
    save_masks(folder / "masks", [np.full((40, 60), 255, np.uint8), lying, np.full((40, 60), 255, np.uint8)])
    moved = np.full((40, 60, 2), (0, 255), np.uint8)  # grey and opacity
    moved[30:, :, 0] = 255
    Image.fromarray(moved).save(folder / "dynamic_mask_p002.png")
    sources = read_sources(folder)
    assert [source.name for source in sources] == ["p000", "p001", "p002"] and sources[0].lossless
    names, _ = shrink_all(sources, tmp_path / "small", 30, False)
    files = [tmp_path / "small" / name for name in names]
    share = write_feature_masks(tmp_path / "out", sources, masks_of(folder, sources, True), files)
    found = [np.asarray(Image.open(tmp_path / "out" / f"{name}.png")) // 255 for name in names]
    expected = [np.ones((20, 30)), np.zeros((30, 20)), np.ones((20, 30))]
    expected[0][:, :10], expected[1][:7], expected[2][15:] = 0, 1, 0
    for mask, goal in zip(found, expected, strict=True):
        assert mask.shape == goal.shape and (mask != goal).mean() < 0.04
    assert share == pytest.approx(np.mean([mask.mean() for mask in expected]), abs=0.02)


def test_masks_of_a_video_are_called_as_its_frames(tmp_path):
    write_video(tmp_path / "a.mp4", moving_pictures(range(0, 40, 4)))
    save_masks(tmp_path / "masks", [np.zeros((9, 9), np.uint8)], "picture_{}.png")
    with pytest.raises(ValueError, match=r": (frame_\d{5}).png or \1.jpg.png"):
        warpcage.capture(tmp_path / "a.mp4", tmp_path / "out", masks=tmp_path / "masks", progress=False)


def test_what_stays_at_its_pixel_in_many_pictures_stands_still():
    """What comes back to it in a few, as of many rounds, does not, nor what is at the pixel and looks different."""
    rng = np.random.default_rng(0)

    def described(count):
        vectors = rng.normal(size=(count, 128))
        return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)

    wall, count = rng.uniform(0, 500, (30, 2)), 20
    marks, spot = described(30), described(1)
    places, vectors = [], []
    for picture in range(count):
        again = [[250.0, 250.0]] if picture in (3, 13) else [[600.0 + 30 * picture, 10.0]]
        places.append(np.concatenate([wall + rng.normal(scale=0.1, size=(30, 2)), again, wall[:5]]))
        vectors.append(np.concatenate([marks, spot, described(5)]))
    for found in still_features(places, vectors):
        np.testing.assert_array_equal(found, [True] * 30 + [False] * 6)
    assert [len(each) for each in still_features([np.zeros((0, 2))] * 3, [np.zeros((0, 128))] * 3)] == [0, 0, 0]


def test_frames_of_a_turntable_are_nearer_each_other():
    """The wall, which has most of what is seen, does not move: a tenth of the usual way is one from view to view."""
    way = np.linspace(0.0, 0.02, 50)
    scores = FrameScores(np.arange(50), np.ones(50), way, (64, 48), 0)
    assert len(pick_frames(scores, 20)) == 5 and len(pick_frames(scores, 20, least_step=0.0004)) == 20
