"""Damaged and hostile files of splats: refused in one line, before what they claim is paid for."""

import gzip
import io
import struct
import zipfile

import numpy as np
import pytest
from hostile import (
    cut,
    instead,
    ksplat,
    members,
    packed,
    put,
    refused,
    require_refused,
    rows,
    save_splats,
    spz_4,
    swap,
    tree,
    whole,
    write_archive,
)
from messages import MESSAGES
from PIL import Image
from splat_scenes import require_usd, some_splats, zstd

import warpcage
from warpcage.core import MemoryShortage
from warpcage.splats import is_splat_file


def webp(shape, noise=False):
    """A picture as a file, of one colour or one that hardly packs."""
    packed = io.BytesIO()
    if noise:
        picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, shape, np.uint8))
    else:
        picture = Image.new("RGBA" if shape[2] == 4 else "RGB", shape[:2], 0)
    picture.save(packed, "WEBP", lossless=True)
    return packed.getvalue()


def spz(version, count, body, degree=0, flags=0):
    """The bytes of an .spz file that says so much and holds that, not packed."""
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, flags, 0) + body


def zipped(data):
    return instead(gzip.compress(data))


MANY = 1 << 20
SIZES = [36, 4, 12, 12, 16]  # of the streams of four splats
CLAIM = f"{MANY} splats of degree 0 claim {20 * MANY} bytes out of"

#: Texts in place of a meta.json.
NO_META = [
    b'{"version": 2, "count": ' + b"9" * 5000 + b"}", b"[1, 2]", b'"version"', b"", b"[" * 100_000, b"\xff\xfe{",
    b'{"version": 2', b"{}",
]  # fmt: skip


def meta(change):
    return tree(lambda files: change(files["meta.json"]), ".sog")


def glb(change):
    return tree(lambda file: change(file["document"]), ".glb")


def file(**files):
    return members({f"{name}.webp": data for name, data in files.items()}, ".sog")


def pack_spz(document):
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    extension["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}


def second_chunk(data, size):
    """Another length of the chunk after the document."""
    return packed("<I", 20 + struct.unpack_from("<I", data, 12)[0], size)(data)


def listed_at(data):
    """Where an archive lists a picture."""
    return data.rfind(b"quats.webp") - 46


def load(path):
    return warpcage.SplatField.load(path, device="cpu")


def parts(first=None):
    return [first or zstd()(bytes(SIZES[0])), *(zstd()(bytes(size)) for size in SIZES[1:])]


NOISE = webp((64, 64, 4), noise=True)
PALETTE = "shN_centroids"

#: By formats: what is done to a file, and what is said.
CLAIMS = {
    "spz": [
        *(
            (kind(spz(version, 0xFFFFFFFF, bytes(100), 3)), "4294967295 splats")
            for version in (1, 2, 3)
            for kind in (instead, zipped)
        ),
        (lambda _: gzip.compress(spz(3, 4, bytes(1 << 25)), 1), "bytes, more than its header says"),
        (lambda _: gzip.compress(spz(3, MANY, bytes(20 * MANY))), CLAIM),
        (zipped(spz(0, 0, b"")), "version 0"),
        (zipped(spz(4, 0, b"")), "1 to 3 in gzip"),
        (zipped(spz(9, 0, b"")), "version 9"),
        (zipped(spz(3, 1, bytes(20) + struct.pack("<III", 0xADBE0003, 4, 17), flags=2)), "system 17 is not known"),
        (zipped(spz(3, 1, bytes(20) + struct.pack("<II", 0xADBE0003, 900), flags=2)), "ends beyond"),
        (lambda data: gzip.compress(gzip.decompress(data)[:9]), "header of 16 bytes, got 9"),
        (lambda data: data[:10] + b"\xff" * 20, "gzip packed in it cannot be unpacked"),
    ],
    "spz 4": [
        (lambda _: spz_4(count=MANY), CLAIM),  # zeros that fit the header: nothing of them is unpacked
        (lambda _: spz_4(parts(zstd()(bytes(1 << 25)))), "36 bytes should be packed by zstd, got more"),
        (lambda _: spz_4(parts(zstd()(bytes(3)))), "36 bytes should be packed by zstd, got 3"),
        (lambda _: spz_4(parts(), [1 << 40, *SIZES[1:]]), "stream 0 must hold 36 bytes"),
        (lambda _: spz_4(parts(), [9 << 32, *SIZES[1:]], count=0xFFFFFFFF), "4294967295 splats"),
        (lambda _: spz_4(parts(), table=0xFFFFFF00), "5 streams expected"),
        (lambda _: spz_4(parts()[:4], SIZES[:4]), "5 streams expected, got 4"),
        (lambda _: spz_4(parts(b"no zstd")), "cannot be unpacked"),
    ],
    "ksplat": [
        (instead(ksplat(sections=0xFFFFFFFF)), "headers of 4294967295 sections"),
        (instead(ksplat(count=0xFFFFFFFF, most=0xFFFFFFFF)), "a section of 4294967295 splats"),
        (instead(ksplat(most=1)), "a section of 2 splats"),
        (instead(ksplat(buckets=0xFFFFFFFF)), "a section of 2 splats"),
        (instead(ksplat(partial=0xFFFFFFFF)), "a section of 2 splats"),
        (instead(ksplat(full=0xFFFFFFFF)), "do not hold 2 splats"),
        (instead(ksplat(size=0xFFFFFFFF)), "do not hold 2 splats"),
        (instead(ksplat(degree=9)), "degree 9"),
        (instead(ksplat(level=3)), "compression 0, 1 and 2"),
        (lambda data: data[:5000], ""),
        (lambda data: data[:-48] + bytes(48), "the scales of its 2 splats are zero: the file was never filled"),
    ],
    "sog": [
        (meta(lambda m: m.update(count=10**12)), "1000000000000 splats"),
        (meta(lambda m: m.update(count=-1)), "whole number"),
        (meta(lambda m: m.update(version=3)), "version 3"),
        (meta(lambda m: m["scales"].update(codebook=[0.0] * 300)), "at most 256 numbers"),
        (meta(lambda m: m["scales"].update(codebook=[0.0])), "codebook of scales has 1 numbers"),
        (meta(lambda m: m["scales"].update(codebook=["a"])), "must be numbers"),
        (meta(lambda m: m["means"].update(mins=[0.0])), "must be 3 numbers"),
        (meta(lambda m: m["quats"].update(files=["../quats.webp"])), "no plain name"),
        (meta(lambda m: m["quats"].update(files="quats.webp")), "must be a list of 1 or more names"),
        (meta(lambda m: m["means"].update(files=["means_l.webp"])), "must be a list of 2 or more names"),
        (meta(lambda m: m["means"].update(mins=[10**400] * 3)), "of another kind"),
        (meta(lambda m: m.update(count=4.0)), "whole number of at least 0, got 4.0"),
        (meta(lambda m: m.update(count="4")), "whole number of at least 0, got '4'"),
        (meta(lambda m: m["shN"].update(count=-5)), "a palette of -5 entries"),
        (meta(lambda m: m["shN"].update(bands="1")), "'1' bands"),
        (meta(lambda m: m.update(count=36_000_000)), "36000000 splats claim"),
        (meta(lambda m: m.pop("quats")), "lacks 'quats'"),
        (meta(lambda m: m.update(means=3)), "another kind"),
        (meta(lambda m: m["shN"].update(bands=3)), "3 bands"),
        (meta(lambda m: m["shN"].update(count=10**9)), "does not fit 1 rows"),
        (file(quats=None), "lacks 'quats.webp'"),
        (file(quats=b"RIFF no picture"), "no WebP and no PNG"),
        (file(quats=b"GIF89a" + bytes(100)), "no WebP and no PNG"),
        (file(quats=NOISE[:900]), "cannot be read"),
        (
            file(quats=packed("<I", 21, 11999 | 11999 << 14)(webp((64, 64, 4), noise=True))),
            "12000 x 12000 pixels for 4 splats",
        ),
        (file(quats=webp((1, 1, 4))), "1 x 1 pixels for 4 splats"),
        (lambda data: file(**{PALETTE: webp((192, 16000, 3))})(data), "at most 65536 entries"),
        (file(**{PALETTE: webp((100, 1, 3))}), "192, 512 or 960 pixels wide, got 100"),
        (lambda data: packed("<I", listed_at(data) + 24, 1 << 31)(data), f"'quats.webp' claims {1 << 31} bytes out of"),
        (lambda data: packed("B", listed_at(data) + 8, 1)(data), "'quats.webp' is encrypted"),
        (instead(b"PK\x03\x04 no archive"), "not a .sog file"),
        (lambda _: write_archive({"meta.json": b" " * (1 << 25)}), f"'meta.json' has {1 << 25} bytes, at most"),
        *((instead(write_archive({"meta.json": text})), "") for text in NO_META),
    ],
    "splats glb": [
        (glb(lambda d: [a.update(count=10**12) for a in d["accessors"]]), "1000000000000 splats"),
        (glb(lambda d: [a.update(count=5) for a in d["accessors"]]), "reads beyond its buffer"),
        (glb(lambda d: d["accessors"][2].update(count=3)), "ROTATION of 4 splats must be (4, 4)"),
        (glb(lambda d: d["accessors"][2].update(type="VEC3")), "must be (4, 4), got (4, 3)"),
        (glb(lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION")), "lack POSITION"),
        (glb(lambda d: d["meshes"][0]["primitives"][0].update(mode=4)), "mode 4"),
        (glb(lambda d: d["nodes"][0].update(matrix=[1e300] * 16)), "a node"),
        (glb(lambda d: d["nodes"][0].update(children=[0])), "two parents"),
        (glb(pack_spz), "begins with"),
        (swap("splatting:SCALE", "splatting:WIDTH"), "lack KHR_gaussian_splatting:SCALE"),
        (packed("<I", 8, 0xFFFFFFFF), "glTF version 2 of 4294967295 bytes expected"),
        (packed("<I", 8, 12), "no chunk of JSON"),
        (packed("<I", 12, 0xFFFFFFFF), "a chunk of 4294967295 bytes"),
        (packed("<I", 12, 0), ""),
        (lambda data: second_chunk(data, 0xFFFFFFF0), "a chunk of 4294967280 bytes"),
        (lambda data: second_chunk(data, 8), ""),
    ],
    "splats ply": [
        (swap("property float rot_3\n", ""), "lack rot_3"),
        (swap("binary_little_endian", "ascii"), "files of text"),
        (swap("little", "middle"), "'binary_middle_endian 1.0'"),
        (swap("vertex 4", "vertex four"), "an element needs a name and a count"),
        (swap("f_rest_8\n", "f_rest_9\n"), "0, 9, 24 or 45"),
        (swap("element vertex", "element point"), "element 'vertex'"),
        (swap("float opacity", "int opacity"), "must be float or double"),
        (swap("property float nx", "property list uchar float nx"), "lists"),
        (swap("float nx", "float x"), "twice"),
        (lambda data: data[:-3], "ends within"),
        # a few such rows are left out: here it is all of them
        (lambda data: data[:-416] + 4 * (data[-104:-4] + np.float32(np.nan).tobytes()), MESSAGES["splats.not_finite"]),
    ],
    "compressed ply": [(swap("uchar f_rest_8\n", "uchar g_rest_8\n"), "'sh' must have 9, 24 or 45 bytes")],
    "splats usda": [
        (swap("Degree = 1", "Degree = 9"), "degree 0 to 3, got 9"),
        (swap("Degree = 1", 'Degree = "1"'), "whole.usda"),
        (swap("Degree = 1", "Degree = 2147483647"), "got 2147483647"),
        (swap("opacities = [", "opacities = [9, "), "opacities must be in [0, 1], got 9"),
        (swap("scales = [", "scales = [(-4, 0, 0), "), "scales must be above 0, got -4"),
        (swap("point3f[] positions", "string[] positions"), "whole.usda"),
        (swap("def Particle", "over Particle"), "it has no splats"),
        (swap('"Y"', '"Q"'), "upAxis of a stage is Y or Z, got 'Q'"),
        (instead("#usda 1.0\n" + "(" * 10_000), "whole.usda"),
        (instead("#usda 1.0\n" + '"' * 10_001), "whole.usda"),
    ],
    "splats usdc": [
        (packed("<Q", 16, 1 << 60), "whole.usdc"),
        (packed("<B", 8, 99), "whole.usdc"),
        (instead(b"PXR-USDC" + bytes(80)), "whole.usdc"),
        (instead(b"#usda 1.0\n"), "begins as .usda files do, not as .usdc files"),
    ],
    "splats usdz": [
        (instead(write_archive({"readme.txt": b"no stage"})), "whole.usdz"),
        (instead(write_archive({"../a.usda": b"#usda 1.0\n"})), "whole.usdz"),
        (instead(write_archive({"a.usda": b"#usda 1.0\n"})), "whole.usdz"),  # packed, which no .usdz is
        (instead(b"PK\x03\x04 no archive"), "whole.usdz"),
    ],
}
SHARES = (0.0, 0.01, 0.3, 0.6, 0.9)
#: The last byte, but of texts and packages of USD, which end before it.
LAST = {name: [(cut(-1), "")] for name in CLAIMS if name not in ("splats usda", "splats usdz")}
TABLE = {
    name: [
        ("", damage, message)
        for damage, message in [*group, *((cut(share), "") for share in SHARES), *LAST.get(name, [])]
    ]
    for name, group in CLAIMS.items()
}


@pytest.mark.parametrize("name, file, damage, message", rows(TABLE))
def test_files_that_claim_too_much_or_are_cut_off(tmp_path, name, file, damage, message):
    require_refused(name, tmp_path, {file: damage(whole(name)[file])}, message)


def test_memory_for_what_is_claimed_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 27)
    archive = write_archive({"meta.json": b" " * (1 << 23)})
    require_refused("sog", tmp_path, {"whole.sog": archive}, f"{1 << 23} bytes of 'meta.json' need", MemoryShortage)

    def change(document):  # many nodes of one mesh
        document["nodes"] += [{"mesh": 0}] * 20_000
        document["scenes"][0].update(nodes=[*range(20_001)])

    (tmp_path / "many.glb").write_bytes(glb(change)(whole("splats glb")["whole.glb"]))
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 26)
    refused(lambda: load(tmp_path / "many.glb"), "many.glb", "20001 nodes come to 80004 splats")


def test_a_folder_of_sog_reads_no_other_folder_and_no_words_that_are_none(tmp_path):
    with zipfile.ZipFile(put(tmp_path, whole("sog")) / "whole.sog") as archive:
        archive.extractall(tmp_path / "set")
    path, picture = tmp_path / "set" / "meta.json", tmp_path / "set" / "quats.webp"
    picture.symlink_to(picture.rename(tmp_path / "secret.webp"))
    refused(lambda: load(path), "meta.json", "leads out of the folder")
    picture.unlink()
    refused(lambda: load(path), "meta.json", "'quats.webp' is not there")
    for text in [*NO_META, b'{"means": []']:
        path.write_bytes(text)
        refused(lambda: load(path), "meta.json")
        assert not is_splat_file(tmp_path / "set")


@pytest.mark.parametrize("ending", [".spz", ".sog", ".glb", ".ply", ".usdc"])
def test_what_cannot_be_written_leaves_what_was_there(ending, tmp_path, monkeypatch):
    if ending == ".usdc":
        require_usd()
    path = tmp_path / f"whole{ending}"
    save_splats(path)
    before = path.read_bytes()
    far = some_splats(4, 0)
    far.centers[2] = 1e12
    if ending == ".spz":
        field = warpcage.SplatField.from_contents(far, device="cpu")
        refused(lambda: field.save(path), "an .spz file holds positions up to")
    monkeypatch.setattr("os.replace", lambda *names: (_ for _ in ()).throw(OSError("the disk is full")))
    refused(lambda: save_splats(path), match="the disk is full", error=OSError)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == [path.name]
