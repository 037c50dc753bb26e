"""Damaged and hostile files of splats: refused in one line, before what they claim is paid for."""

import gzip
import io
import json
import os
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from splat_scenes import require_read_or_refused, some_splats, zstd

import warpcage
from warpcage.core import MemoryShortage
from warpcage.splats import is_splat_file

#: Bytes that reading a file of some kilobytes may take.
LITTLE = 1 << 24


def refused(path, *words, error=ValueError):
    """A file is refused, for little memory, in one line that names it and holds all the words."""
    tracemalloc.start()
    try:
        with pytest.raises(error) as caught:
            warpcage.SplatField.load(path, device="cpu")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert "\n" not in message and path.name in message, message
    for word in words:
        assert word in message, message
    assert peak < LITTLE + 4 * (path.stat().st_size if path.is_file() else 0)


def saved(folder, ending, count=4, degree=1, **options):
    path = folder / f"whole{ending}"
    warpcage.SplatField.from_contents(some_splats(count, degree), device="cpu").save(path, **options)
    return path


def webp(shape, value=0):
    packed = io.BytesIO()
    Image.new("RGBA" if shape[2] == 4 else "RGB", shape[:2], value).save(packed, "WEBP", lossless=True)
    return packed.getvalue()


def noise(size):
    """A picture that hardly packs."""
    packed = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 256, (*size, 4), np.uint8)
    Image.fromarray(pixels).save(packed, "WEBP", lossless=True)
    return packed.getvalue()


def repacked(path, **changes):
    """An archive with other files in it; a text changes the meta.json."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    for name, value in changes.items():
        if name == "meta":
            value(meta)
        elif value is None:
            del files[name]
        else:
            files[name] = value
    files["meta.json"] = json.dumps(meta).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


# Claims


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_that_claims_too_much(version, packed, tmp_path):
    data = struct.pack("<4sIIBBBB", b"NGSP", version, 0xFFFFFFFF, 3, 12, 0, 0) + bytes(100)
    path = tmp_path / "claims.spz"
    path.write_bytes(gzip.compress(data) if packed else data)
    refused(path, "4294967295 splats")


def test_spz_whose_gzip_holds_more_than_its_header_tells(tmp_path):
    path = tmp_path / "bomb.spz"
    path.write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 4, 0, 12, 0, 0) + bytes(1 << 27)))
    refused(path, "bytes are packed in it, which its header does not tell")


def test_spz_that_packs_what_no_splats_pack_to(tmp_path):
    """Zeros that fit the header: nothing of them is unpacked."""
    path, count = tmp_path / "bomb.spz", 1 << 22
    path.write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0) + bytes(20 * count)))
    refused(path, f"{count} splats of degree 0 claim {20 * count} bytes out of")
    pack, sizes = zstd(), [9 * count, count, 3 * count, 3 * count, 4 * count]
    path.write_bytes(spz_4([pack(bytes(size)) for size in sizes], sizes, count=count))
    refused(path, f"{count} splats of degree 0 claim {20 * count} bytes out of")


def spz_4(streams, sizes=None, table=32, count=4, degree=0):
    sizes = sizes or [9 * count, count, 3 * count, 3 * count, 4 * count]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(streams), table)
    return (
        head + b"".join(struct.pack("<QQ", len(s), n) for s, n in zip(streams, sizes, strict=True)) + b"".join(streams)
    )


def test_spz_4_that_claims_or_packs_too_much(tmp_path):
    pack = zstd()
    parts = [pack(bytes(size)) for size in (36, 4, 12, 12, 16)]
    path = tmp_path / "claims.spz"
    path.write_bytes(spz_4([pack(bytes(1 << 28)), *parts[1:]]))
    refused(path, "36 bytes should be packed by zstd, got more")
    path.write_bytes(spz_4([pack(bytes(3)), *parts[1:]]))
    refused(path, "36 bytes should be packed by zstd, got 3")
    path.write_bytes(spz_4(parts, sizes=[1 << 40, 4, 12, 12, 16]))
    refused(path, "stream 0 must hold 36 bytes")
    path.write_bytes(spz_4(parts, count=0xFFFFFFFF, sizes=[9 << 32, 4, 12, 12, 16]))
    refused(path, "4294967295 splats")
    path.write_bytes(spz_4(parts, table=0xFFFFFF00))
    refused(path, "5 streams expected")
    path.write_bytes(spz_4(parts[:4], sizes=[36, 4, 12, 12]))
    refused(path, "5 streams expected, got 4")
    path.write_bytes(spz_4([b"no zstd", *parts[1:]]))
    refused(path, "cannot be unpacked")


@pytest.mark.parametrize("version, words", [(0, "version 0"), (4, "1 to 3 in gzip"), (9, "version 9")])
def test_spz_of_other_versions(version, words, tmp_path):
    path = tmp_path / "other.spz"
    path.write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, 0, 0, 12, 0, 0)))
    refused(path, words)


def test_spz_with_extensions_that_are_none(tmp_path):
    for extension, words in (
        (struct.pack("<III", 0xADBE0003, 4, 17), "coordinate system 17 is not known"),
        (struct.pack("<II", 0xADBE0003, 900), "ends beyond"),
    ):
        body = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 2, 0) + bytes(20) + extension
        (tmp_path / "a.spz").write_bytes(gzip.compress(body))
        refused(tmp_path / "a.spz", words)


def ksplat(**head):
    data = bytearray(4096 + 1024)
    values = {"sections": 1, "count": 2, "level": 1, "most": 2, "size": 2, "buckets": 1, "full": 1, "partial": 0}
    values |= {"degree": 0} | head
    struct.pack_into("<BB2xIIIIH", data, 0, 0, 1, values["sections"], 1, 2, 2, values["level"])
    first = (values[name] for name in ("count", "most", "size", "buckets"))
    last = (values[name] for name in ("full", "partial", "degree"))
    struct.pack_into("<IIIIfH2xIIIIH", data, 4096, *first, 5.0, 12, 0, 0, *last)
    return bytes(data) + bytes(12 + 2 * 24)


@pytest.mark.parametrize(
    "head, words",
    [
        ({"sections": 0xFFFFFFFF}, "headers of 4294967295 sections"),
        ({"count": 0xFFFFFFFF, "most": 0xFFFFFFFF}, "a section of 4294967295 splats"),
        ({"most": 1}, "a section of 2 splats"),
        ({"buckets": 0xFFFFFFFF}, "a section of 2 splats"),
        ({"partial": 0xFFFFFFFF}, "a section of 2 splats"),
        ({"full": 0xFFFFFFFF}, "do not hold 2 splats"),
        ({"size": 0xFFFFFFFF}, "do not hold 2 splats"),
        ({"degree": 9}, "degree 9"),
        ({"level": 3}, "compression 0, 1 and 2"),
    ],
)
def test_ksplat_that_claims_too_much(head, words, tmp_path):
    path = tmp_path / "claims.ksplat"
    path.write_bytes(ksplat(**head))
    refused(path, words)
    path.write_bytes(ksplat()[:5000])
    refused(path)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"meta": lambda meta: meta.update(count=10**12)}, "1000000000000 splats"),
        ({"meta": lambda meta: meta.update(count=-1)}, "whole number"),
        ({"meta": lambda meta: meta.update(version=3)}, "version 3"),
        ({"meta": lambda meta: meta["scales"].update(codebook=[0.0] * 300)}, "at most 256 numbers"),
        ({"meta": lambda meta: meta["scales"].update(codebook=[0.0])}, "codebook of scales has 1 numbers"),
        ({"meta": lambda meta: meta["scales"].update(codebook=["a"])}, "must be numbers"),
        ({"meta": lambda meta: meta["means"].update(mins=[0.0])}, "must be 3 numbers"),
        ({"meta": lambda meta: meta["quats"].update(files=["../quats.webp"])}, "no plain name"),
        ({"meta": lambda meta: meta["quats"].update(files="quats.webp")}, "must be a list of 1 or more names"),
        ({"meta": lambda meta: meta["means"].update(files=["means_l.webp"])}, "must be a list of 2 or more names"),
        ({"meta": lambda meta: meta["means"].update(mins=[10**400] * 3)}, "of another kind"),
        ({"meta": lambda meta: meta.update(count=4.0)}, "whole number, got 4.0"),
        ({"meta": lambda meta: meta.update(count="4")}, "whole number, got '4'"),
        ({"meta": lambda meta: meta["shN"].update(count=-5)}, "a palette of -5 entries"),
        ({"meta": lambda meta: meta["shN"].update(bands="1")}, "'1' bands"),
        ({"meta": lambda meta: meta.update(count=36_000_000)}, "36000000 splats claim"),
        ({"meta": lambda meta: meta.pop("quats")}, "lacks 'quats'"),
        ({"meta": lambda meta: meta.update(means=3)}, "another kind"),
        ({"quats.webp": None}, "lacks 'quats.webp'"),
        ({"quats.webp": b"RIFF no picture"}, "no WebP and no PNG"),
        ({"quats.webp": b"GIF89a" + bytes(100)}, "no WebP and no PNG"),
        ({"quats.webp": noise((64, 64))[:900]}, "cannot be read"),
        ({"quats.webp": webp((12000, 12000, 4))}, "12000 x 12000 pixels for 4 splats"),
        ({"quats.webp": webp((1, 1, 4))}, "1 x 1 pixels for 4 splats"),
        ({"shN_centroids.webp": webp((192, 16000, 3))}, "at most 65536 entries"),
        ({"shN_centroids.webp": webp((100, 1, 3))}, "192, 512 or 960 pixels wide, got 100"),
        ({"meta": lambda meta: meta["shN"].update(bands=3)}, "3 bands"),
        ({"meta": lambda meta: meta["shN"].update(count=10**9)}, "does not fit 1 rows"),
    ],
)
def test_sog_that_claims_too_much(change, words, tmp_path):
    refused(repacked(saved(tmp_path, ".sog"), **change), words)


def test_sog_archives_that_claim_too_much(tmp_path, monkeypatch):
    path = saved(tmp_path, ".sog")
    data = path.read_bytes()
    name = b"quats.webp"
    place = data.rfind(name) - 46  # in the directory: packed and unpacked sizes
    size = struct.unpack_from("<I", data, place + 24)[0]
    path.write_bytes(data[: place + 24] + struct.pack("<I", 1 << 31) + data[place + 28 :])
    refused(path, f"'quats.webp' claims {1 << 31} bytes out of {size}")
    path.write_bytes(b"PK\x03\x04 no archive")
    refused(path, "not a .sog file")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 23))
    with monkeypatch.context() as little:
        little.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 27)
        refused(path, f"{1 << 23} bytes of 'meta.json' need", error=MemoryShortage)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 25))
    refused(path, f"'meta.json' has {1 << 25} bytes, at most")
    path = saved(tmp_path, ".sog")
    data = bytearray(path.read_bytes())
    data[data.rfind(name) - 38] |= 1
    path.write_bytes(data)
    refused(path, "'quats.webp' is encrypted")


#: Texts in place of a meta.json.
NO_META = {
    "digits": b'{"version": 2, "count": ' + b"9" * 5000 + b"}",
    "list": b"[1, 2]",
    "text": b'"version"',
    "nothing": b"",
    "nested": b"[" * 100_000,
    "no text": b"\xff\xfe{",
    "broken off": b'{"version": 2',
    "empty": b"{}",
}


@pytest.mark.parametrize("kind", list(NO_META))
def test_sog_whose_words_are_no_words(kind, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", NO_META[kind])
    refused(tmp_path / "a.sog")
    (tmp_path / "meta.json").write_bytes(NO_META[kind])
    refused(tmp_path / "meta.json")
    assert not is_splat_file(tmp_path)


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="no links")
def test_a_folder_of_sog_reads_no_other_folder(tmp_path):
    with zipfile.ZipFile(saved(tmp_path, ".sog")) as archive:
        archive.extractall(tmp_path / "set")
    (tmp_path / "set" / "quats.webp").rename(tmp_path / "secret.webp")
    os.symlink(tmp_path / "secret.webp", tmp_path / "set" / "quats.webp")
    refused(tmp_path / "set" / "meta.json", "leads out of the folder")
    (tmp_path / "set" / "quats.webp").unlink()
    refused(tmp_path / "set" / "meta.json", "'quats.webp' is not there")
    (tmp_path / "set" / "meta.json").write_text('{"means": []')
    assert not is_splat_file(tmp_path / "set")


def changed_glb(path, change):
    """A .glb file with another document."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + size :]
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def pack_spz(document):
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    extension["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda d: [a.update(count=10**12) for a in d["accessors"]], "1000000000000 splats"),
        (lambda d: [a.update(count=5) for a in d["accessors"]], "reads beyond its buffer"),
        (lambda d: d["accessors"][2].update(count=3), "ROTATION of 4 splats must be (4, 4)"),
        (lambda d: d["accessors"][2].update(type="VEC3"), "must be (4, 4), got (4, 3)"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "lack POSITION"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=4), "mode 4"),
        (lambda d: d["nodes"].extend([{"mesh": 0}] * 200_000) or d["scenes"][0].update(nodes=[*range(200_001)]), ""),
        (lambda d: d["nodes"][0].update(matrix=[1e300] * 16), "a node"),
        (lambda d: d["nodes"][0].update(children=[0]), "two parents"),
        (pack_spz, "begins with"),
    ],
)
def test_gltf_that_claims_too_much(change, words, tmp_path, monkeypatch):
    path = changed_glb(saved(tmp_path, ".glb"), change)
    if not words:  # many nodes of one mesh
        monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 30)
        with pytest.raises(ValueError, match="200001 nodes come to 800004 splats"):
            warpcage.SplatField.load(path, device="cpu")
        return
    refused(path, words)


@pytest.mark.parametrize(
    "place, size, words",
    [
        (8, 0xFFFFFFFF, "glTF version 2 of 4294967295 bytes expected"),
        (8, 12, "no chunk of JSON"),
        (12, 0xFFFFFFFF, "a chunk of 4294967295 bytes"),
        (12, 0, ""),
        (None, 0xFFFFFFF0, "a chunk of 4294967280 bytes"),
        (None, 8, ""),
    ],
)
def test_glb_with_wrong_lengths(place, size, words, tmp_path):
    path = saved(tmp_path, ".glb")
    data = bytearray(path.read_bytes())
    second = 20 + struct.unpack_from("<I", data, 12)[0]  # the length of the binary chunk
    struct.pack_into("<I", data, second if place is None else place, size)
    path.write_bytes(data)
    refused(path, words)


# Output


@pytest.mark.parametrize("ending", [".spz", ".sog", ".glb", ".ply"])
def test_what_cannot_be_written_leaves_what_was_there(ending, tmp_path, monkeypatch):
    path = saved(tmp_path, ending)
    before = path.read_bytes()
    far = some_splats(4, 0)
    far.centers[2] = 1e12
    if ending == ".spz":
        with pytest.raises(ValueError, match="an .spz file holds positions up to"):
            warpcage.SplatField.from_contents(far, device="cpu").save(path)
    monkeypatch.setattr("os.replace", lambda *names: (_ for _ in ()).throw(OSError("the disk is full")))
    with pytest.raises(OSError, match="the disk is full"):
        saved(tmp_path, ending, 5)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == [path.name]


# Damage


CASES = {".spz": {}, ".spz 4": {"version": 4}, ".sog": {}, ".glb": {}, ".ksplat": {}}


def whole_file(folder, name):
    if name == ".ksplat":
        path = folder / "whole.ksplat"
        path.write_bytes(ksplat())
        return path
    if name == ".spz 4":
        zstd()
    return saved(folder, name.split()[0], **CASES[name])


@pytest.mark.parametrize("name", list(CASES))
def test_files_that_were_cut_off(name, tmp_path):
    path = whole_file(tmp_path, name)
    data = path.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.6, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        refused(path)
    path.write_bytes(data[:-1])
    refused(path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", list(CASES))
@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_damaged_files_are_refused_or_read(name, data, tmp_path_factory):
    """Bytes changed or put in never give anything but ValueError; of what is packed they are changed inside."""
    folder = tmp_path_factory.getbasetemp() / "damaged"
    folder.mkdir(exist_ok=True)
    path = whole_file(folder, name)
    whole = path.read_bytes()
    packed = name == ".spz"
    changed = bytearray(gzip.decompress(whole) if packed else whole)
    inside = len(changed) if name != ".glb" else min(len(changed), 3000)
    for _ in range(data.draw(st.integers(1, 5))):
        place = data.draw(st.integers(0, inside - 1))
        if data.draw(st.booleans()):
            changed[place] = data.draw(st.integers(0, 255))
        else:
            changed[place:place] = data.draw(st.binary(max_size=3))
    path.write_bytes(gzip.compress(bytes(changed)) if packed else bytes(changed))
    require_read_or_refused(path)


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_damaged_words_of_sog_are_refused_or_read(data, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "words"
    folder.mkdir(exist_ok=True)
    path = saved(folder, ".sog")

    def change(meta):
        owner = meta[data.draw(st.sampled_from(["means", "scales", "quats", "sh0", "shN"]))]
        if data.draw(st.booleans()):
            owner = meta
        key = data.draw(st.sampled_from(sorted(owner)))
        value = (
            st.none()
            | st.integers(-3, 10**6)
            | st.floats()
            | st.text(max_size=3)
            | st.lists(st.integers(0, 5), max_size=4)
        )
        owner[key] = data.draw(value)

    repacked(path, meta=change)
    try:
        warpcage.SplatField.load(path, device="cpu")
    except ValueError as error:
        assert "\n" not in str(error) and path.name in str(error)
