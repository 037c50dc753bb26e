"""What files cut is counted and said once: splats, pictures, films, fields, scenes; what they only round is silent."""

import dataclasses
import json
import warnings

import numpy as np
import pytest
from fields import make_field
from splat_scenes import field_of, loaded, some_splats, zstd

import warpcage
from warpcage import Camera, Scene, SplatField, SurfaceMesh, VoxelField
from warpcage.field import LayeredBackground
from warpcage.studio.cli import main
from warpcage.studio.films.video import write_film
from warpcage.view import linear_light, read_exr, read_image, write_jpeg, write_picture, write_png


def said(work):
    """What warnings a piece of work gives."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        work()
    return [str(each.message) for each in found]


def splats(count=40, **changes):
    """Splats of degree 1 within the range of all formats; changes: of the arrays, as [(row, value)]."""
    contents = some_splats(count, 1)
    contents = dataclasses.replace(
        contents, log_scales=np.full((count, 3), -3.0, np.float32), harmonics=0.2 * contents.harmonics
    )
    for name, rows in changes.items():
        for row, value in rows:
            getattr(contents, name)[row] = value
    return field_of(contents)


# Splats

DC, REST, LOGS = "values of f_dc", "values of f_rest", "values of log scales"
FAR = [((3, 0, 0), -20.0), ((7, 0, 1), 5.0)]  # of the first harmonics
TINY = [(slice(None), -100.0)]  # all scales
STEEP = [((2, 1, 0), 11.25), ((2, 3, 2), -4.5), ((9, 2, 1), 1.5)]  # of others

CUT = {  # ending, version, array, values: what is said of them, what comes back
    "spz f_dc": (".spz", 3, "harmonics", FAR, f"2 of 120 {DC} beyond -3.33 to 3.33, by up to 16.7", [-10 / 3, 10 / 3]),
    "spz 4 f_dc": (".spz", 4, "harmonics", FAR, f"2 of 120 {DC} beyond -3.33 to 3.33", [-10 / 3, 10 / 3]),
    "spz f_rest": (".spz", 3, "harmonics", STEEP, f"3 of 360 {REST} beyond -1 to 0.992", [127 / 128, -1, 127 / 128]),
    "spz flat": (
        ".spz",
        3,
        "log_scales",
        TINY,
        f"120 of 120 {LOGS} beyond -10 to 5.94, by up to 90",
        [[[-10] * 3] * 40],
    ),
    "spz huge": (".spz", 3, "log_scales", [((5, 2), 7.0)], f"1 of 120 {LOGS}", [5.9375]),
    "compressed f_dc": (".compressed.ply", None, "harmonics", FAR, "", [-20, 5]),  # ranges are those of the chunk
    "compressed f_rest": (".compressed.ply", None, "harmonics", STEEP, f"2 of 360 {REST} beyond -4 to 4", [4, -4, 1.5]),
    "compressed flat": (".compressed.ply", None, "log_scales", TINY, f"120 of 120 {LOGS}", [[[-20] * 3] * 40]),
    "splat f_dc": (".splat", None, "harmonics", FAR, f"2 of 120 {DC} beyond -1.77 to 1.77", [-1.7725, 1.7725]),
    "splat f_rest": (".splat", None, "harmonics", STEEP, f"360 of 360 {REST} other than 0, by up to 11.2", None),
    "splat point": (
        ".splat",
        None,
        "log_scales",
        TINY,
        f"120 of 120 {LOGS} beyond -87.3 to 40",
        [[[-87.336] * 3] * 40],
    ),
    "glb point": (".glb", None, "log_scales", TINY, f"120 of 120 {LOGS} beyond -87.3 to 40", [[[-87.336] * 3] * 40]),
    "glb harmonics": (".glb", None, "harmonics", FAR + STEEP, "", [-20, 5, 11.25, -4.5, 1.5]),
    "sog harmonics": (".sog", None, "harmonics", FAR + STEEP, "", [-20, 5, 11.25, -4.5, 1.5]),
    "sog flat": (".sog", None, "log_scales", [((5,), -24.0)], "", [[-24] * 3]),
    "ply all": (".ply", None, "harmonics", FAR + STEEP, "", [-20, 5, 11.25, -4.5, 1.5]),
}


@pytest.mark.parametrize("row", list(CUT))
def test_values_beyond_a_format_of_splats_are_counted(row, tmp_path):
    ending, version, name, changes, words, back = CUT[row]
    if version == 4:
        zstd()
    field = splats(**{name: changes})
    lines = said(lambda: field.save(tmp_path / f"a{ending}", version=version))
    assert len(lines) == bool(words) and all(words in line and f"a{ending}: cut to what" in line for line in lines)
    assert all("\n" not in line and ": .ply files keep it" in line for line in lines)
    again = loaded(tmp_path / f"a{ending}")
    if back is not None:
        found = [getattr(again.contents, name)[each[0]] for each in changes]
        np.testing.assert_allclose(found, back, atol=0.05)  # 25 in 255 or 256 numbers


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".sog", ".glb", ".ply"])
def test_values_within_a_format_of_splats_are_silent(ending, tmp_path):
    """Half a step beyond its ends; a few flat and small splats, as fits have; opacities of 0 and 1, infinite logits."""
    edges = [((1, 0, 0), 10 / 3 + 0.012), ((1, 1, 0), -1.0038), ((2, 1, 1), 0.996)]
    logits = [(4, np.inf), (5, -np.inf), (6, 30.0)]
    field = splats(harmonics=edges, logits=logits, log_scales=[((8, 0), -18.0), ((9,), -14.0)])
    assert said(lambda: field.save(tmp_path / f"a{ending}")) == []
    again = loaded(tmp_path / f"a{ending}")
    assert len(again) == len(field) and np.abs(again.opacities - field.opacities).max() <= 0.5 / 255 + 1e-6
    if ending not in (".ply", ".glb"):
        assert np.isfinite(again.contents.logits).all()  # bytes that others read as infinite


def test_what_makes_up_for_a_strong_first_harmonic_is_kept_where_it_can_be(tmp_path):
    """As LichtFeld Studio writes them: among more splats than SOG has kinds of harmonics, each shows its colour."""
    rng, count = np.random.default_rng(0), 70_000
    harmonics = rng.normal(size=(count, 4, 3)) * np.array([1.0, 0.1, 0.1, 0.1])[:, None]
    far = rng.choice(count, 20, replace=False)
    y0, y1 = 0.28209479, 0.48860251
    harmonics[far], harmonics[far, 0], harmonics[far, 1] = 0.0, -20.0, (0.2 - 20 * y0) / y1
    places, logs = rng.normal(size=(count, 3)).astype(np.float32), np.full((count, 3), -3.0)
    field = SplatField(places, logs, np.zeros((count, 4)), np.zeros(count), harmonics, device="cpu")
    assert said(lambda: field.save(tmp_path / "a.sog")) == []
    again = loaded(tmp_path / "a.sog").contents.harmonics[far]
    np.testing.assert_allclose(0.5 + y0 * again[:, 0] - y1 * again[:, 1], 0.3, atol=2e-3)


def test_positions_of_fine_splats_are_kept_or_said(tmp_path):
    """SPZ takes more bits for them; chunks of compressed PLY are of splats that are near one another."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (3000, 3)).astype(np.float32)
    values = np.zeros((3000, 4)), np.zeros(3000), np.zeros((3000, 1, 3))
    fine = SplatField(1e-3 * places, np.full((3000, 3), np.log(1e-5)), *values, device="cpu")
    shuffled = SplatField(places, np.full((3000, 3), np.log(1.2e-2)), *values, device="cpu")
    far = SplatField(np.concatenate([places[:-1], [[3e5, 0, 0]]]), np.full((3000, 3), -5.0), *values, device="cpu")
    assert LOGS in said(lambda: fine.save(tmp_path / "a.spz"))[0]  # and nothing of positions
    assert np.abs(loaded(tmp_path / "a.spz").centers - fine.centers).max() < 1e-6
    assert said(lambda: shuffled.save(tmp_path / "a.compressed.ply")) == []
    again = loaded(tmp_path / "a.compressed.ply").centers
    gaps = np.sqrt(((again[:, None] - shuffled.centers[None]) ** 2).sum(axis=2).min(axis=1))
    assert np.quantile(gaps, 0.9) < 7e-4  # the same splats in another order; in the first one it is 9e-4
    (line,) = said(lambda: far.save(tmp_path / "far.spz"))
    assert ".spz files round these positions to 0.0625 units, and splats of 0.00674 units with them" in line


def test_info_says_what_a_format_holds_and_what_the_file_has(tmp_path, capsys):
    for ending, words in {
        ".spz": "f_dc -3.333 to 0.7974; .spz holds -3.333 to 3.333, 2 at its ends",
        ".ply": "f_dc -20 to 0.8",
    }.items():
        changes = [((0, 0), 0.8), ((3, 0, 0), -20.0), ((4, 0, 2), -5.0)]
        field = splats(5, harmonics=[(slice(None), 0.1), *changes])
        said(lambda field=field, path=tmp_path / f"a{ending}": field.save(path))
        assert main(["info", str(tmp_path / f"a{ending}")]) == 0
        assert words in [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]


# Pictures and films


def picture(far=(), beside=(), channels=3):
    """A picture (20, 30, c) in [0, 1] but for some values."""
    image = np.random.default_rng(0).random((20, 30, channels)).astype(np.float32)
    for k, value in enumerate([*far, *beside]):
        image[k, 2 * k, k % 3] = value
    return image


WRITERS = {
    ".png": write_png,
    ".jpg": write_jpeg,
    ".exr": write_picture,
    ".mp4": lambda path, image: write_film(path, [image, image], 24),
    ".mov": lambda path, image: write_film(path, [image, image], 24),
    ".webm": lambda path, image: write_film(path, [image, image], 24),
    ".gif": lambda path, image: write_film(path, [image, image], 10),
}


@pytest.mark.parametrize("ending", list(WRITERS))
def test_pictures_say_what_they_cut_and_films_say_it_once(ending, tmp_path):
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    path, frames = tmp_path / f"a{ending}", 1 if ending in (".png", ".jpg", ".exr") else 2
    assert said(lambda: WRITERS[ending](path, picture(beside=[1.004, 1.3, -0.05]))) == []
    far = [400.0, 250.0, -2.0] if ending == ".exr" else [3.0, 1.2, -0.6]
    (line,) = said(lambda: WRITERS[ending](path, picture(far)))
    reach = {".exr": "0 to 107, by up to 293"}.get(ending, "0 to 1, by up to 2")
    assert f"a{ending}: cut to what its format holds: {3 * frames} of {1800 * frames} values of pixels" in line
    assert f"beyond {reach}" in line and line.endswith(".exr files keep light above 1") == (ending != ".exr")
    if ending == ".exr":
        light = read_exr(path)["RGB"]
        assert (light[0, 0, 0], light[1, 2, 1], light[2, 4, 2]) == (65504, 65504, 0)
        return
    if ending == ".png":
        np.testing.assert_array_equal(read_image(path)[[0, 1, 2], [0, 2, 4], [0, 1, 2]], [1, 1, 0])
    bright = np.full((20, 30, 3), 1.2, np.float32)  # no highlight: all of it
    (line,) = said(lambda: WRITERS[ending](path, bright))
    assert f"{1800 * frames} of {1800 * frames} values of pixels beyond 0 to 1, by up to 0.2" in line


def test_whole_numbers_that_are_no_bytes_are_not_taken_for_shares_in_silence(tmp_path):
    (line,) = said(lambda: write_png(tmp_path / "a.png", np.full((4, 4), 200)))
    assert "16 of 16 values of pixels beyond 0 to 1, by up to 199" in line


@pytest.mark.parametrize("ending", [".png", ".exr"])
def test_transparent_pictures_count_their_opacities(ending, tmp_path):
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    image = picture(channels=4)
    image[3, 4, 3] = 1.75
    (line,) = said(lambda: write_picture(tmp_path / f"a{ending}", image))
    assert "1 of" in line and "by up to 0.75" in line


def test_frames_that_are_rendered_say_it_once_a_save(tmp_path):
    places = np.array([[0.0, 0, 0]])
    field = SplatField.from_arrays(places, [[0.5] * 3], None, [0.99], harmonics=np.full((1, 1, 3), 9.0), device="cpu")
    plain = SplatField.from_arrays(places, [[0.5] * 3], None, [0.99], colors=[[1.03] * 3], device="cpu")
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=33, height=33, up=(0, 0, 1))
    for background in ("black", "transparent"):
        for which, count in ((field, 1), (plain, 0)):
            frame = which.render(camera, background=background)
            assert len(said(lambda frame=frame: frame.save(tmp_path / "a.png"))) == count
    for name, size in (("film", 33), ("film.mp4", 33)):
        (line,) = said(lambda name=name: warpcage.render_film(field, tmp_path / name, camera=[camera] * 3))
        assert f"{name}: cut to what its format holds: " in line and f" of {3 * size**2 * 3} values" in line
        assert (
            said(lambda name=name: warpcage.render_film(plain, tmp_path / f"plain {name}", camera=[camera] * 3)) == []
        )


def test_a_batch_says_it_once_a_worker(tmp_path):
    bright_field(4.0).save(tmp_path / "ball.npz")
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), width=16, height=16)
    warpcage.CameraFile([camera]).save(tmp_path / "side.json")
    view = {"field": "ball.npz", "camera": "side.json#0", "background": "black", "outputs": {"rgb": "{id}.png"}}
    lines = [{"format": "warpcage jobs", "version": 1}, *({"id": f"f{k}", **view} for k in range(3))]
    (tmp_path / "jobs.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (line,) = said(lambda: warpcage.run_jobs(tmp_path / "jobs.jsonl", tmp_path / "out", device="cpu"))
    assert ".png: cut to what its format holds: " in line and line.endswith("others are not reported")


def test_the_colors_of_an_mp4_are_those_that_it_names(tmp_path):
    """Players guess by the size where nothing is said: BT.709 for large pictures, whose green is another."""
    av = pytest.importorskip("av")
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]], np.uint8)
    write_film(tmp_path / "a.mp4", [np.repeat(np.repeat(colors[None], 32, 0), 32, 1)] * 2, 24)
    with av.open(str(tmp_path / "a.mp4")) as film:
        frame = next(film.decode(video=0))
    assert (frame.colorspace, frame.color_range) == (1, 1) and (frame.width, frame.height) == (128, 32)
    planes = [np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size) for plane in frame.planes]
    y, u, v = (plane[plane.shape[0] // 2] for plane in planes)
    luma, blue, red = (y[16:128:32] - 16.0) / 219, (u[8:64:16] - 128.0) / 224, (v[8:64:16] - 128.0) / 224
    r, b = luma + 1.5748 * red, luma + 1.8556 * blue  # BT.709
    rgb = np.stack([r, (luma - 0.2126 * r - 0.0722 * b) / 0.7152, b], axis=1)
    np.testing.assert_allclose(255 * rgb, colors, atol=3)


STRIDES = {
    "Fortran": np.asfortranarray,
    "turned": lambda image: np.ascontiguousarray(image.transpose(1, 0, 2)).transpose(1, 0, 2),
    "every second": lambda image: np.repeat(np.repeat(image, 2, 0), 3, 1)[::2, ::3],
    "upside down": lambda image: image[::-1].copy()[::-1],
    "BGR": lambda image: image[..., ::-1].copy()[..., ::-1],
}


@pytest.mark.parametrize("kind", list(STRIDES))
@pytest.mark.parametrize("ending", [".png", ".exr", ".mp4", ".mov", ".webm", ".gif", ".jpg"])
def test_pictures_of_any_strides_are_the_same_files(ending, kind, tmp_path):
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    image = picture()
    (tmp_path / "plain").mkdir()
    for folder, given in (("plain", image), (".", STRIDES[kind](image))):
        WRITERS[ending](tmp_path / folder / f"a{ending}", given)
    if ending == ".exr":
        np.testing.assert_allclose(read_exr(tmp_path / "a.exr")["RGB"], linear_light(image), atol=5e-4)
    elif ending == ".webm":  # its files have a number drawn at random
        assert (tmp_path / "a.webm").stat().st_size == (tmp_path / "plain/a.webm").stat().st_size
    else:
        assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"plain/a{ending}").read_bytes()


# Fields, meshes and scenes

FIELDS = {  # format, what is changed, what is said
    "half": ("warpcage", {"sh": 7e4}, "1 of {sh} harmonics beyond -6.55e+04 to 6.55e+04, by up to 4.5e+03"),
    "half, svox2": ("svox2", {"sh": -7e4}, "1 of {sh} harmonics beyond -6.55e+04 to 6.55e+04"),
    "compact": ("compact", {"sh": 300.0}, "1 of {sh} harmonics beyond -256 to 256, by up to 44"),
    "compact density": ("compact", {"density": 1e7}, "1 of {density} densities of a voxel's side beyond -6.55e+04"),
    "nothing": ("compact", {"sh": 255.0}, ""),
}


@pytest.mark.parametrize("row", list(FIELDS))
def test_fields_say_what_their_files_cut(row, tmp_path):
    form, changes, words = FIELDS[row]
    values = {"density": np.full(64, 3.0, np.float32), "sh": np.full((64, 9, 3), 0.25, np.float32)}
    for name, value in changes.items():
        values[name].reshape(-1)[-1] = value
    links = np.arange(64, dtype=np.int32).reshape(4, 4, 4)
    field = VoxelField([[-1, -1, -1], [1, 1, 1]], links, values["density"], values["sh"], device="cpu")
    lines = said(lambda: field.save(tmp_path / "a.npz", format=form))
    words = words.format(**{name: value.size for name, value in values.items()})
    assert len(lines) == bool(words) and all(words in line and "a.npz: cut to what" in line for line in lines)


def test_compact_fields_round_densities_to_the_nearest(tmp_path):
    """To 7 bits of mantissa, up and down alike."""
    density = np.random.default_rng(0).uniform(1.0, 100.0, 4096).astype(np.float32)
    links = np.arange(4096, dtype=np.int32).reshape(16, 16, 16)
    field = VoxelField([[-1, -1, -1], [1, 1, 1]], links, density, np.zeros((4096, 9, 3), np.float32), device="cpu")
    field.save(tmp_path / "a.npz", format="compact")
    ratio = VoxelField.load(tmp_path / "a.npz", device="cpu").node_densities().ravel() / density
    assert np.abs(ratio - 1).max() <= 0.5**8 + 0.5**11 and abs(ratio.mean() - 1) < 2e-4


def test_backgrounds_say_what_bytes_cut(tmp_path):
    rows = np.full((2, 6 * 4**2 + 2, 4), 0.5, np.float32)
    links = np.arange(64, dtype=np.int32).reshape(4, 4, 4)
    for value, count in ((1.2, 0), (2.5, 1)):
        rows[0, 3, 1] = value
        layers = LayeredBackground((0, 0, 0), 2.0, 4, rows, device="cpu")
        values = np.ones(64), np.zeros((64, 9, 3))
        field = VoxelField([[-1, -1, -1], [1, 1, 1]], links, *values, background_model=layers, device="cpu")
        lines = said(lambda field=field: field.save(tmp_path / "a.npz"))
        assert len(lines) == count
        assert all("1 of 588 colors of background layers beyond 0 to 1, by up to 1.5" in line for line in lines)


def bright_field(first):
    """A ball whose first harmonics are some number."""
    sh = np.zeros((9, 3))
    sh[0] = first
    return make_field(
        lambda x: 90.0 * (np.linalg.norm(x, axis=-1) < 0.6),
        lambda x: np.broadcast_to(sh, (*x.shape[:3], 9, 3)),
        device="cpu",
    )


def test_volumes_keep_light_above_1(tmp_path):
    """Their numbers are floats: nothing of them is cut."""
    assert said(lambda: bright_field(4.0).save(tmp_path / "a.nvdb")) == []
    light = linear_light(np.float32(0.5 + 4.0 * 0.28209479177387814))
    assert light > 3.0 and (tmp_path / "a.nvdb").read_bytes().count(np.tile(light, 3).tobytes()) > 100


def test_colors_of_meshes_say_what_bytes_cut():
    assert said(lambda: bright_field(1.9).extract_mesh(colors=True)) == []  # 1.036
    (line,) = said(lambda: bright_field(4.0).extract_mesh(colors=True))
    assert "colors of the mesh: cut to what its format holds: " in line and "by up to 0.628" in line
    corners, picture = np.eye(3), np.full((4, 4, 3), 0.5)
    picture[1, 2, 0] = 2.0
    (line,) = said(lambda: SurfaceMesh(corners, [[0, 1, 2]], uv=corners[:, :2], texture=picture, device="cpu"))
    assert "the texture: cut to what its format holds: 1 of 48 values of pixels" in line


def test_masks_of_a_scene_say_which_weights_they_cut(tmp_path):
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=8, height=6, up=(0, 0, 1))
    weights = np.ones((1, 6, 8), np.float32)
    weights[0, 0, :4], weights[0, 1, :3] = 0.0, 0.5
    scene = Scene(np.full((1, 6, 8, 3), 0.5), None, [camera], weights=weights)
    (line,) = said(lambda: scene.save(tmp_path / "scene"))
    assert "3 of 48 that count in part count no more" in line
