"""Formats of files of splats: round trips; SPZ 1 to 4, ksplat, SOG and glTF as bytes; formats of other packages."""

import functools
import gzip
import io
import json
import struct
import zipfile

import numpy as np
import pytest
from entry_points import plug
from field_oracles import basis
from messages import MESSAGES
from PIL import Image
from refusals import refused
from splat_scenes import DATA, SH_0, SH_1, VALUES, field_of, loaded, needs_data, require_usd, some_splats, zstd

import warpcage
from warpcage.splats import SplatContents, SplatFormat, is_splat_file, splat_formats
from warpcage.studio.cli import main

#: Where x, y and z point in the coordinate systems of SPZ, by their numbers from 1 on.
SYSTEMS = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()
WAYS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


def colors_along(field, directions):
    """(n, 3) the colours of splats along directions (n, 3) in the field's axes, before they are cut at 0."""
    count = field.contents.harmonics.shape[1]
    return np.einsum("nb,nbc->nc", basis(directions, int(np.sqrt(count))), field.contents.harmonics)


# Errors of round trips

FORMATS = {  # ending, version: errors of place, logarithm of scale, turn, opacity, first harmonic, further harmonics
    (".spz", 3): (1.3e-4, 3.2e-2, 2.5e-3, 2e-3, 1.4e-2, 4e-3),
    (".spz", 4): (1.3e-4, 3.2e-2, 2.5e-3, 2e-3, 1.4e-2, 4e-3),
    (".sog", None): (7e-5, 2e-2, 1.2e-2, 2e-3, 3e-3, 3e-3),
    (".glb", None): (0.0, 1e-6, 1e-6, 1e-7, 0.0, 0.0),
    (".ply", None): (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (".compressed.ply", None): (2e-3, 2e-3, 2e-3, 2e-3, 3e-3, 1.6e-2),
    (".splat", None): (0.0, 1e-6, 1.2e-2, 2e-3, 7e-3, 0.0),
    **{(ending, None): (0.0, 1e-6, 1e-6, 1e-7, 0.0, 0.0) for ending in (".usd", ".usda", ".usdc", ".usdz")},
}


@pytest.mark.parametrize("ending, version", list(FORMATS))
def test_round_trips_keep_what_they_say(ending, version, tmp_path):
    if version == 4:
        zstd()
    if ending.startswith(".usd"):
        require_usd()
    field = field_of(some_splats())
    field.save(tmp_path / f"a{ending}", version=version)
    again = loaded(tmp_path / f"a{ending}")
    place, scale, turn, opacity, color, further = FORMATS[ending, version]
    old, new = field.contents, again.contents
    assert np.abs(new.centers - old.centers).max() <= place
    assert np.abs(new.log_scales - old.log_scales).max() <= scale
    assert np.abs(again.rotations @ again.rotations.transpose(0, 2, 1) - np.eye(3)).max() < 1e-6
    # a splat's own axes may be turned half about one of them: what counts is its shape
    assert np.abs(np.abs(again.rotations) - np.abs(field.rotations)).max() <= 2 * turn
    shape, other = (each.covariances / (each.scales**2).max(axis=1)[:, None, None] for each in (field, again))
    assert np.abs(shape - other).max() <= 2 * turn + 2 * scale
    assert np.abs(again.opacities - field.opacities).max() <= opacity
    assert np.abs(new.harmonics[:, 0] - old.harmonics[:, 0]).max() <= color
    kept = new.harmonics.shape[1]
    assert kept == (1 if ending == ".splat" else 16)
    assert np.abs(new.harmonics[:, 1:] - old.harmonics[:, 1:kept]).max(initial=0.0) <= further
    for name in VALUES if ending == ".ply" else ():
        np.testing.assert_array_equal(getattr(new, name), getattr(old, name))


@pytest.mark.parametrize("ending", [".ply", ".spz", ".sog", ".glb", ".usdc"])
@pytest.mark.parametrize("degree, count", [(0, 1), (1, 7), (2, 0), (2, 5)])
def test_any_degree_and_number(ending, degree, count, tmp_path):
    if ending.startswith(".usd"):
        require_usd()
    contents = some_splats(count, degree)
    field_of(contents).save(tmp_path / f"a{ending}")
    again = loaded(tmp_path / f"a{ending}")
    assert again.splat_count == count and (again.degree == degree or not count)
    if count:
        np.testing.assert_allclose(again.contents.harmonics[:, 1:], contents.harmonics[:, 1:], atol=4e-3)


@pytest.mark.parametrize("ending, version", [(".spz", 3), (".spz", 4), (".sog", None)])
def test_antialias_is_kept_and_drawn(ending, version, tmp_path):
    if version == 4:
        zstd()
    camera = warpcage.Camera.look_at((0, 0, -8), (0, 0, 0), width=24, height=24)
    for antialias in (False, True):
        field_of(some_splats(antialias=antialias)).save(tmp_path / f"a{ending}", version=version)
        again = loaded(tmp_path / f"a{ending}")
        assert again.antialias is antialias and again.chosen([0, 1]).antialias is antialias
        shown = again.render(camera).rgb
        np.testing.assert_array_equal(shown, again.render(camera, antialias=antialias).rgb)
        assert np.abs(shown - again.render(camera, antialias=not antialias).rgb).max() > 1e-3
    cage = warpcage.Cage.box((-3, -3, -3), (3, 3, 3))
    deformer = warpcage.Deformer(again, cage, coordinates="mean_value").pose(cage)
    np.testing.assert_array_equal(deformer.render(camera).rgb, deformer.render(camera, antialias=True).rgb)
    assert warpcage.bake(deformer).antialias


@pytest.mark.parametrize(
    "name, version, said",
    [
        ("a.spz", 2, "version 3 and 4 are written, got 2"),
        ("a.ply", 3, "files are not written with version"),
        ("a.ksplat", None, "must end in .* to be written"),
    ],
)
def test_versions_that_are_not_written(tmp_path, name, version, said):
    refused(lambda: field_of(some_splats(3)).save(tmp_path / name, version=version), match=said)
    assert list(tmp_path.iterdir()) == []


# SPZ as bytes


def spz_parts(version):
    """The parts of a file of one splat at (1, 2, -0.5) in its axes, turned a quarter about x: positions, opacities,
    colours, scales, rotations, harmonics of degree 1."""
    if version == 1:
        place = np.array([1.0, 2.0, -0.5], "<f2").tobytes()
    else:
        place = b"".join(int(4096 * value).to_bytes(3, "little", signed=True) for value in (1.0, 2.0, -0.5))
    if version < 3:
        turn = bytes([round((np.sqrt(0.5) + 1) * 127.5), 128, 128])
    else:  # w is the largest, of 3; x at 20 bits: 511 of 511
        turn = ((3 << 30) | (511 << 20)).to_bytes(4, "little")
    octets = bytes([128 + 32, 128, 128, 128, 128 + 64, 128, 128, 128, 128 - 32])  # y: red, z: green, x: blue
    return [place, bytes([51]), bytes([255, 128, 0]), bytes([160, 144, 128]), turn, octets]


def spz_file(version, parts, *, degree=1, flags=0, count=1, packed=None, extensions=b""):
    """The bytes of a file."""
    if version < 4:
        data = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, flags, 0) + b"".join(parts) + extensions
        return gzip.compress(data) if packed else data
    streams = [zstd()(part) for part in parts]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, flags, len(parts), 32 + len(extensions))
    table = b"".join(struct.pack("<QQ", len(s), len(p)) for s, p in zip(streams, parts, strict=True))
    return head + extensions + table + b"".join(streams)


def assert_is_spz_splat(field, axes="RUB", antialias=False):
    """The splat of `spz_parts`, in a file whose axes point so."""
    own = np.array([WAYS[letter] for letter in axes]).T  # columns: where the axes of the file point
    np.testing.assert_allclose(field.contents.centers, [own @ [1.0, 2.0, -0.5]], atol=1e-6)
    turned = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    shape = own @ turned @ np.diag(np.exp([0.0, -2.0, -4.0])) @ turned.T @ own.T
    np.testing.assert_allclose(field.covariances, [shape], atol=2e-2)
    np.testing.assert_allclose(field.opacities, [0.2], atol=1e-6)
    np.testing.assert_allclose(field.contents.harmonics[0, 0], (np.array([255, 128, 0]) / 255 - 0.5) / 0.15, rtol=1e-5)
    direction = np.array([[0.6, 0.0, 0.8]])
    x, y, z = direction[0] @ own  # the same direction in the axes of the file
    first = SH_0 * field.contents.harmonics[0, 0]
    expected = first + SH_1 * np.array([-0.25 * y, 0.5 * z, 0.25 * x])
    np.testing.assert_allclose(colors_along(field, direction)[0], expected, atol=1e-5)
    assert field.antialias is antialias


@pytest.mark.parametrize("version, packed", [(1, False), (2, True), (3, False), (3, True), (4, None)])
def test_spz_by_hand(version, packed, tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(spz_file(version, spz_parts(version), packed=packed, flags=int(version < 4)))
    assert_is_spz_splat(loaded(path), antialias=version < 4)


@pytest.mark.parametrize("axes", SYSTEMS)
def test_spz_in_declared_axes(axes, tmp_path):
    """A file says where its axes point; what it says of other objects is passed over."""
    other = struct.pack("<II", 0x12340001, 3) + b"abc"
    extensions = other + struct.pack("<III", 0xADBE0003, 4, SYSTEMS.index(axes) + 1)
    path = tmp_path / "a.spz"
    path.write_bytes(spz_file(3, spz_parts(3), flags=2, packed=True, extensions=extensions))
    assert_is_spz_splat(loaded(path), axes)


def test_spz_holds_places_of_three_bytes_and_nothing_after_them(tmp_path):
    contents = some_splats(2)
    contents.centers[:] = [[40.25, -300.5, 7.75], [-1000.125, 9.5, 0.0]]
    field_of(contents).save(tmp_path / "a.spz")
    np.testing.assert_allclose(loaded(tmp_path / "a.spz").contents.centers, contents.centers, atol=1 / 4096)
    (tmp_path / "a.spz").write_bytes(spz_file(3, [*spz_parts(3), b"more"], packed=True))  # no flag announces extensions
    refused(lambda: loaded(tmp_path / "a.spz"), match="of degree 1 take 45 bytes, got 49")


def test_spz_4_declares_its_axes(tmp_path):
    zstd()
    field_of(some_splats(5)).save(tmp_path / "a.spz", version=4)
    data = (tmp_path / "a.spz").read_bytes()
    magic, version, count, degree, _, flags, streams, table = struct.unpack_from("<4sIIBBBBI", data)
    assert (magic, version, count, degree, flags, streams, table) == (b"NGSP", 4, 5, 3, 2, 6, 44)
    assert struct.unpack_from("<III", data, 32) == (0xADBE0003, 4, SYSTEMS.index("RUB") + 1)


def test_spz_of_degree_4_keeps_degree_3(tmp_path):
    parts = spz_parts(3)[:5] + [bytes(range(72))]
    (tmp_path / "a.spz").write_bytes(spz_file(3, parts, degree=4))
    with pytest.warns(UserWarning, match="harmonics of degree 4 are left out"):
        field = loaded(tmp_path / "a.spz")
    assert field.degree == 3
    np.testing.assert_allclose(np.abs(field.contents.harmonics[0, 15]), (128 - np.array([42, 43, 44])) / 128, atol=1e-6)


# ksplat as bytes


def ksplat_file(level, degree, rows, buckets=b"", full_and_partial=(0, 0)):
    """A file of one section; rows: the bytes of splats of 2 buckets, the first full."""
    count = len(rows)
    main_head = bytearray(4096)
    struct.pack_into("<BB2xIIIIH2x3f2f", main_head, 0, 0, 1, 1, 1, count, count, level, 0, 0, 0, -0.5, 1.0)
    section = bytearray(1024)
    full, partial = full_and_partial
    struct.pack_into(
        "<IIIIfH2xIIIIH", section, 0, count, count, 2, full + partial, 4.0, 12, 32767, 0, full, partial, degree
    )
    return bytes(main_head + section) + buckets + b"".join(rows)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_ksplat_by_hand(level, tmp_path):
    places = np.array([[0.5, -1.0, 2.0], [1.0, 0.0, 0.0], [10.0, 20.0, 30.5]])
    middles = np.array([[0.0, 0.0, 1.0], [10.0, 20.0, 30.0]], "<f4")
    of = np.array([0, 0, 1])
    harmonics = np.array([0.25, 0.5, 0.75, -0.5, 0.0, 1.0, 0.1, 0.2, 0.3])  # red of all three, then green, then blue
    rows = []
    for place, bucket in zip(places, of, strict=True):
        if level:
            row = np.round((place - middles[bucket]) / 2.0 * 32767 + 32767).astype("<u2").tobytes()
        else:
            row = place.astype("<f4").tobytes()
        kind = "<f2" if level else "<f4"
        row += np.array([0.5, 0.25, 0.125, 1, 0, 0, 0], kind).tobytes() + bytes([255, 0, 128, 51])
        if level == 2:
            row += np.round((harmonics + 0.5) / 1.5 * 255).astype("u1").tobytes()
        else:
            row += harmonics.astype(kind).tobytes()
        rows.append(row)
    held = np.array([1], "<u4").tobytes() + middles.tobytes()
    data = ksplat_file(level, 1, rows, held if level else b"", full_and_partial=(1, 1) if level else (0, 0))
    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    field = loaded(path)
    np.testing.assert_allclose(field.contents.centers, places, atol=1e-4)
    np.testing.assert_allclose(field.scales, [[0.5, 0.25, 0.125]] * 3, rtol=1e-6)
    np.testing.assert_array_equal(field.contents.quaternions, [[1, 0, 0, 0]] * 3)
    np.testing.assert_allclose(field.opacities, 0.2, atol=1e-6)
    np.testing.assert_allclose(0.5 + SH_0 * field.contents.harmonics[:, 0], [[1.0, 0.0, 128 / 255]] * 3, atol=1e-6)
    expected = harmonics.reshape(3, 3).T
    np.testing.assert_allclose(field.contents.harmonics[1, 1:], expected, atol={0: 1e-7, 1: 1e-3, 2: 3e-3}[level])


# SOG as arrays


def webp(pixels):
    packed = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(packed, "WEBP", lossless=True, exact=True)
    return packed.getvalue()


def sog_set(version):
    """The files of a set of two splats of degree 1, and what they hold."""
    low, high = np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 3.0])
    uint16s = np.array([[0, 65535, 32768], [65535, 0, 255]])
    logs = low + (high - low) * uint16s / 65535
    pictures = {"means_l": uint16s & 255, "means_u": uint16s >> 8, "scales": [[0, 1, 2], [2, 2, 0]]}
    # the largest is w, and z: the others by the square root of two in -1 to 1
    pictures["quats"] = [[255, 128, 128, 252], [128, 128, 255, 255]]
    pictures["sh0"] = [[0, 1, 2, 51], [2, 1, 0, 204]]
    book = np.array([-5.0, -4.0, -3.0])
    if version == 2:
        meta = {"version": 2, "count": 2, "scales": {"codebook": book.tolist()}, "sh0": {"codebook": [-1.0, 0.0, 0.5]}}
        meta["shN"] = {"count": 2, "bands": 1, "codebook": [-0.5, 0.0, 0.25, 0.75]}
    else:
        ends = {"mins": [-5.0] * 3, "maxs": [-5.0 + 255] * 3}
        meta = {"scales": ends, "sh0": {"mins": [-1, -1, -1, -2], "maxs": [254, 254, 254, 3]}}
        meta["shN"] = {"mins": -0.5, "maxs": 254.5}
    meta["means"] = {"shape": [2, 3], "mins": low.tolist(), "maxs": high.tolist()}
    meta["quats"] = {}
    palette = np.zeros((1, 192, 3), np.uint8)
    palette[0, 3:6] = [[1, 2, 3], [0, 0, 0], [3, 2, 1]]  # the second entry: y, z, x of red, green, blue
    files = {}
    for name, rows in pictures.items():
        rows = np.asarray(rows, np.uint8)
        cells = np.zeros((16, rows.shape[1]), np.uint8)
        cells[:2] = rows
        files[f"{name}.webp"] = webp(cells.reshape(4, 4, -1))
    labels = np.zeros((4, 4, 3), np.uint8)
    labels[0, 1, 0] = 1
    files |= {"c.webp": webp(palette), "l.webp": webp(labels)}
    meta["means"]["files"] = ["means_l.webp", "means_u.webp"]
    for name in ("scales", "quats", "sh0"):
        meta[name]["files"] = [f"{name}.webp"]
    meta["shN"]["files"] = ["c.webp", "l.webp"]
    return meta, files, np.sign(logs) * (np.exp(np.abs(logs)) - 1)


def write_sog(folder, meta, files, *, packed, within=""):
    """A folder, or an archive; within: a folder of the archive. Returns its path."""
    contents = {"meta.json": json.dumps(meta).encode(), **files}
    if packed:
        path = folder / "a.sog"
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in contents.items():
                archive.writestr(f"{within}{name}", data)
        return path
    path = folder / "set"
    path.mkdir()
    for name, data in contents.items():
        (path / name).write_bytes(data)
    return path


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("version", [1, 2])
def test_sog_by_hand(version, packed, tmp_path):
    meta, files, places = sog_set(version)
    path = write_sog(tmp_path, meta, files, packed=packed)
    assert is_splat_file(path)
    field = loaded(path)
    np.testing.assert_allclose(field.contents.centers, places, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(field.contents.log_scales, [[-5, -4, -3], [-3, -3, -5]], atol=1e-5)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(field.contents.quaternions, [[half, half, 0, 0], [0, 0, half, half]], atol=4e-3)
    if version == 2:
        np.testing.assert_allclose(field.opacities, [0.2, 0.8], atol=1e-6)
        np.testing.assert_allclose(field.contents.harmonics[:, 0], [[-1, 0, 0.5], [0.5, 0, -1]], atol=1e-6)
        further = [[0.0, 0.25, 0.75], [-0.5, -0.5, -0.5], [0.75, 0.25, 0.0]]
    else:
        np.testing.assert_allclose(field.contents.logits, [-1.0, 2.0], atol=1e-6)
        np.testing.assert_allclose(field.contents.harmonics[:, 0], [[-1, 0, 1], [1, 0, -1]], atol=1e-5)
        further = [[0.5, 1.5, 2.5], [-0.5, -0.5, -0.5], [2.5, 1.5, 0.5]]
    np.testing.assert_allclose(field.contents.harmonics[1, 1:], further, atol=1e-5)
    np.testing.assert_allclose(field.contents.harmonics[0, 1:], -0.5, atol=1e-5)
    if not packed:
        np.testing.assert_array_equal(loaded(path / "meta.json").contents.centers, field.contents.centers)


def test_sog_of_a_folder_that_was_packed(tmp_path):
    """As the menus of file browsers pack one: the files are in a folder of the archive."""
    meta, files, places = sog_set(2)
    path = write_sog(tmp_path, meta, files | {"._meta.json": b"x"}, packed=True, within="my set/")
    np.testing.assert_allclose(loaded(path).contents.centers, places, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("ending, meant", [(".splat", ".spz"), (".spz", ".ply"), (".ksplat", ".glb"), (".glb", ".sog")])
def test_files_of_another_ending_say_which(tmp_path, ending, meant):
    field_of(some_splats(32)).save(tmp_path / f"a{meant}")
    path = (tmp_path / f"a{meant}").rename(tmp_path / f"b{ending}")
    refused(lambda: loaded(path), match=f"b{ending} begins as {meant} files do, not as {ending} files")


def test_sog_of_more_splats_than_its_palette_has(tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.splats.io.sog._MAX_ENTRIES", 64)
    rng = np.random.default_rng(0)
    contents = some_splats(2000, 1)
    contents.harmonics[:, 1:] = rng.normal(size=(40, 3, 3))[rng.integers(0, 40, 2000)]  # forty kinds of them
    contents.harmonics[:, 1:] += rng.normal(scale=1e-3, size=(2000, 3, 3))
    field_of(contents).save(tmp_path / "a.sog")
    again = loaded(tmp_path / "a.sog").contents.harmonics[:, 1:]
    error = np.abs(again - contents.harmonics[:, 1:])
    assert np.median(error) < 0.02 and error.mean() < 0.25 * np.abs(contents.harmonics[:, 1:]).mean()


def test_equal_splats_are_equal_files(tmp_path):
    for name in ("a.sog", "b.sog"):
        field_of(some_splats(50)).save(tmp_path / name)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


# glTF as bytes


def gltf_document(spz=None, node=None, counts=2, changes=None):
    """A document of two splats with plain values, or with what SPZ packs, and its buffer."""
    attributes, accessors, views, body = {}, [], [], b""
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | (changes or {})
    values = {
        "POSITION": (np.array([[1, 2, 3], [-1, 0, 0.5]], "<f4"), "VEC3", False),
        "KHR_gaussian_splatting:ROTATION": (np.array([[0, 0, 0, 127], [127, 0, 0, 0]], "i1"), "VEC4", True),
        "KHR_gaussian_splatting:SCALE": (np.array([[1, 2, 0.5], [0.1, 0.2, 0.3]], "<f4"), "VEC3", False),
        "KHR_gaussian_splatting:OPACITY": (np.array([[51], [255]], "u1"), "SCALAR", True),
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": (np.array([[1, 0, -1], [0.5, 0.5, 0.5]], "<f4"), "VEC3", False),
    }
    axes = {0: [[0.1, 0, 0]] * 2, 1: [[0, 0.2, 0]] * 2, 2: [[0, 0, 0.3]] * 2}
    for k, rows in axes.items():
        values[f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{k}"] = (np.array(rows, "<f4"), "VEC3", False)
    if spz is not None:
        values = {"POSITION": (None, "VEC3", False)}
        views.append({"buffer": 0, "byteOffset": 0, "byteLength": len(spz)})
        extension["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
        body = spz
    for name, (array, kind, normalized) in values.items():
        attributes[name] = len(accessors)
        accessor = {"componentType": 5126, "count": counts, "type": kind}
        if array is not None:
            body += bytes(-len(body) % 4)
            codes = {"f4": 5126, "i1": 5120, "u1": 5121}
            accessor |= {"componentType": codes[array.dtype.str[1:]], "bufferView": len(views)}
            accessor |= {"normalized": True} if normalized else {}
            views.append({"buffer": 0, "byteOffset": len(body), "byteLength": array.nbytes})
            body += array.tobytes()
        accessors.append(accessor)
    primitive = {"attributes": attributes, "mode": 0, "extensions": {"KHR_gaussian_splatting": extension}}
    document = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0} | (node or {})]}
    document |= {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views}
    return document | {"buffers": [{"byteLength": len(body)}]}, body


def glb(document, body):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body += bytes(-len(body) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def write_gltf(folder, document, body, ending):
    path = folder / f"a{ending}"
    if ending == ".glb":
        path.write_bytes(glb(document, body))
    else:
        (folder / "a.bin").write_bytes(body)
        document["buffers"][0]["uri"] = "a.bin"
        path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
def test_gltf_by_hand(ending, tmp_path):
    """x to the left, y up, z to the front; numbers of one byte are shares."""
    path = write_gltf(tmp_path, *gltf_document(), ending)
    assert is_splat_file(path)
    field = loaded(path)
    np.testing.assert_array_equal(field.contents.centers, [[-1, -2, 3], [1, 0, 0.5]])
    np.testing.assert_allclose(field.scales, [[1, 2, 0.5], [0.1, 0.2, 0.3]], rtol=1e-6)
    np.testing.assert_allclose(field.opacities, [0.2, 1.0], rtol=1e-6)
    np.testing.assert_allclose(field.covariances[0], np.diag([1.0, 4.0, 0.25]), rtol=1e-6)
    np.testing.assert_array_equal(field.contents.harmonics[:, 0], [[1, 0, -1], [0.5, 0.5, 0.5]])
    x, y, z = -0.6, 0.0, 0.8  # in the axes of the file
    expected = [SH_0 - SH_1 * 0.1 * y, SH_1 * 0.2 * z, -SH_0 - SH_1 * 0.3 * x]
    np.testing.assert_allclose(colors_along(field, np.array([[0.6, 0.0, 0.8]] * 2))[0], expected, atol=1e-6)


def test_gltf_nodes_move_their_splats(tmp_path):
    """A quarter about y, twice as large, three to the left: as points, shapes and colours."""
    plain = loaded(write_gltf(tmp_path, *gltf_document(), ".glb"))
    half = float(np.sqrt(0.5))
    node = {"translation": [3, 0, 0], "rotation": [0, half, 0, half], "scale": [2, 2, 2]}
    moved = loaded(write_gltf(tmp_path, *gltf_document(node=node), ".glb"))
    own = np.diag([-1.0, -1.0, 1.0])
    turn = own @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ own
    expected = 2 * plain.contents.centers @ turn.T + own @ [3, 0, 0]
    np.testing.assert_allclose(moved.contents.centers, expected, atol=1e-5)
    np.testing.assert_allclose(moved.covariances, 4 * turn @ plain.covariances @ turn.T, atol=1e-5)
    direction = np.array([[0.6, 0.0, 0.8]] * 2)
    np.testing.assert_allclose(colors_along(moved, direction), colors_along(plain, direction @ turn), atol=1e-6)
    uneven = write_gltf(tmp_path, *gltf_document(node={"scale": [1, 2, 1]}), ".glb")
    refused(lambda: loaded(uneven), match="a.glb.* stretches its splats unevenly")


@pytest.mark.parametrize("version", [2, 3])
def test_gltf_with_spz_is_the_same_splats(version, tmp_path):
    data = spz_file(version, spz_parts(version), packed=True)
    path = write_gltf(tmp_path, *gltf_document(spz=data, counts=1), ".glb")
    assert_is_spz_splat(loaded(path))


def test_gltf_of_unknown_kernels_says_so(tmp_path):
    path = write_gltf(tmp_path, *gltf_document(changes={"colorSpace": "lin_rec709_display"}), ".glb")
    with pytest.warns(UserWarning, match="colorSpace 'lin_rec709_display'"):
        loaded(path)


def test_a_glb_of_a_mesh_is_no_splats(tmp_path):
    warpcage.Cage.box((0, 0, 0), (1, 1, 1)).save(tmp_path / "cage.glb")
    assert not is_splat_file(tmp_path / "cage.glb")
    refused(lambda: loaded(tmp_path / "cage.glb"), match="no node of its scene has a mesh")


# Given files


@needs_data
def test_given_files_are_the_same_four_splats():
    plain = loaded(DATA / "minimal.splat")
    for name in ("minimal.ksplat", "minimal-v4.spz"):
        if "v4" in name:
            zstd()
        field = loaded(DATA / name)
        np.testing.assert_allclose(field.contents.centers, plain.contents.centers, atol=1e-6)
        np.testing.assert_allclose(field.covariances, plain.covariances, atol=3e-4)
        np.testing.assert_allclose(field.opacities, plain.opacities, atol=1e-6)
        np.testing.assert_allclose(field.contents.harmonics, plain.contents.harmonics, atol=2e-2)
    raw, packed = (loaded(DATA / f"minimal-{kind}.spz").contents for kind in ("raw", "v2"))
    for name in VALUES:
        np.testing.assert_array_equal(getattr(raw, name), getattr(packed, name))


@needs_data
def test_a_given_set_of_sog(tmp_path, capsys):
    field = loaded(DATA / "playbot_sog")
    assert (field.splat_count, field.degree) == (1873, 2)
    low, high = field.contents.centers.min(axis=0), field.contents.centers.max(axis=0)
    assert low[1] < -1.0 and high[1] < 0.1  # it stands on the ground, y down
    field.save(tmp_path / "again.sog")
    again = loaded(tmp_path / "again.sog")
    np.testing.assert_allclose(again.opacities, field.opacities, atol=1e-6)
    for name, error in (("centers", 3e-5), ("log_scales", 1e-6), ("harmonics", 1e-6)):
        np.testing.assert_allclose(getattr(again.contents, name), getattr(field.contents, name), atol=error)
    assert main(["info", str(DATA / "playbot_sog")]) == 0
    assert "PlayCanvas SOG in a folder" in capsys.readouterr().out


# Formats of other packages


@pytest.fixture
def registered(monkeypatch):
    """Registers what another package would; asked for anew, as it is looked for once a process."""
    from warpcage.splats.io import formats

    yield functools.partial(plug, monkeypatch, formats.ENTRY_POINTS, formats.other_formats)
    formats.other_formats.cache_clear()


def test_another_package_can_register_a_format(registered, tmp_path, capsys, monkeypatch):
    def read(path):
        places = np.loadtxt(path, ndmin=2).astype(np.float32)
        whole = some_splats(len(places), 0)
        return SplatContents(places, whole.log_scales, whole.quaternions, whole.logits, whole.harmonics)

    def write(contents):
        return "\n".join(" ".join(map(str, row)) for row in contents.centers.tolist()).encode()

    registered(xyz=SplatFormat("text of places", (".xyzsplat",), read, write))
    assert "text of places" in [each.name for each in splat_formats()]
    path = tmp_path / "a.xyzsplat"
    field_of(some_splats(5)).save(path)
    np.testing.assert_array_equal(loaded(path).contents.centers, some_splats(5).centers)
    assert main(["info", str(path)]) == 0 and "text of places" in capsys.readouterr().out
    (tmp_path / "a.unknown").write_bytes(b"")
    assert main(["info", str(tmp_path / "a.unknown")]) == 2
    text = capsys.readouterr().err
    assert all(ending in text for ending in (".xyzsplat", ".ksplat", ".sog", ".glb")) and text.count("\n") == 1


@pytest.mark.parametrize("value", [ImportError("no module"), "a text", SplatFormat("without a dot", ("splats",))])
def test_a_format_that_cannot_be_loaded_is_left_out(value, registered, tmp_path):
    registered(xyz=value)
    with pytest.warns(UserWarning, match=MESSAGES["splats.format_unusable"]):
        assert not is_splat_file(tmp_path / "a.xyzsplat")
