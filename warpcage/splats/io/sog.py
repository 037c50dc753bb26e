"""SOG, of PlayCanvas: splats in pictures by codebooks, in a folder with a meta.json (version 1 or 2) or a .sog file."""

from __future__ import annotations

import io
import json
import pathlib
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.checks import checked_whole, shown, warn_caller
from ...core.files import DAMAGED, JSON_ROOM, damage, read_json, read_limited
from ...core.memory import MemoryShortage, require_host_memory
from ...errors import InputError
from .compressed import with_largest, without_largest
from .contents import DEGREES, SplatContents, byte_logits, opacities_of
from .unpacking import read_member, require_packed, zip_members

#: Numbers of a codebook.
CODES = 256

#: Rounds in which the numbers of a codebook move to the middle of what they stand for.
_ROUNDS = 40


def codebook(values: np.ndarray) -> np.ndarray:
    """(256,) float64, rising: the numbers that stand for values of any shape with a small mean squared difference."""
    flat = np.sort(values.astype(np.float64), axis=None)
    distinct = np.unique(flat)
    if len(distinct) <= CODES:  # each value is a number itself
        return np.concatenate([distinct, np.full(CODES - len(distinct), distinct[-1] if len(distinct) else 0.0)])
    # half of them where the values are, half evenly over their range, so that few far values have one near; then
    # Lloyd's rounds, for which sums over the sorted values are differences of running sums
    share = np.linspace(0.0, 1.0, CODES // 2)
    codes = np.sort(np.concatenate([np.quantile(flat, share), flat[0] + share * (flat[-1] - flat[0])]))
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(_ROUNDS):
        ends = np.searchsorted(flat, 0.5 * (codes[1:] + codes[:-1]))
        begins, ends = np.concatenate([[0], ends]), np.concatenate([ends, [len(flat)]])
        counts = ends - begins
        means = (sums[ends] - sums[begins]) / np.maximum(counts, 1)
        moved = np.sort(np.where(counts > 0, means, codes))
        if np.array_equal(moved, codes):
            break
        codes = moved
    return codes


def nearest(codes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The place (uint8) of the nearest number of a rising codebook, for values of any shape."""
    return np.searchsorted(0.5 * (codes[1:] + codes[:-1]), values.astype(np.float64)).astype(np.uint8)


def palette(vectors: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `most` vectors (k, d) float64 that stand for vectors (n, d), and which stands for each (n,) int64.
    Up to `most` of them are all their own."""
    vectors = vectors.astype(np.float64)
    count = len(vectors)
    if count <= most:
        return vectors, np.arange(count)
    # cells are halved at the middle of the direction in which they are widest, all of one level at once; three quarters
    # of them are those with the largest errors, cut at the mean there, so that few far vectors have one of their own
    labels, cells = np.zeros(count, np.int64), 1
    while 8 * cells <= most:
        sizes, _, along = _widest(vectors, labels, cells)
        order = np.lexsort((along, labels))
        begins = np.cumsum(sizes) - sizes
        rank = np.empty(count, np.int64)
        rank[order] = np.arange(count) - begins[labels[order]]
        labels = 2 * labels + (rank >= (sizes[labels] + 1) // 2)
        cells *= 2
    while cells < most:
        sizes, errors, along = _widest(vectors, labels, cells)
        room = -(-3 * (most - cells) // 4)
        worst = np.argsort(-errors, kind="stable")[:room]
        worst = worst[errors[worst] > 0.0]
        if not len(worst):
            break
        new = np.full(cells, -1)
        new[worst] = cells + np.arange(len(worst))
        middles = np.bincount(labels, along, cells) / np.maximum(sizes, 1)
        labels = np.where((new[labels] >= 0) & (along > middles[labels]), new[labels], labels)
        cells += len(worst)
    used, labels = np.unique(labels, return_inverse=True)
    sizes = np.bincount(labels, minlength=len(used))
    means = [np.bincount(labels, vectors[:, k], len(used)) / sizes for k in range(vectors.shape[1])]
    return np.stack(means, axis=1), labels


def _widest(vectors: np.ndarray, labels: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of cells of vectors (n, d), which labels (n,) name: how many each has (k,), the sum of their squared distances
    from the mean (k,), and each vector's number (n,) in the direction in which its cell is widest."""
    sizes = np.bincount(labels, minlength=cells)
    spread = np.empty((cells, vectors.shape[1]))
    for k in range(vectors.shape[1]):
        mean = np.bincount(labels, vectors[:, k], cells) / np.maximum(sizes, 1)
        spread[:, k] = np.bincount(labels, (vectors[:, k] - mean[labels]) ** 2, cells)
    return sizes, spread.sum(axis=1), vectors[np.arange(len(vectors)), spread.argmax(axis=1)[labels]]


#: The file that describes the others.
META = "meta.json"

#: Most bytes of that file in an archive, of which others have some thousand.
_MAX_META = 1 << 24

#: Entries of the palette of harmonics in a row of its picture, and at most.
_ROW, _MAX_ENTRIES = 64, 1 << 16

#: What the fourth number of a quaternion's pixel is counted from: which of w, x, y and z is the largest.
_LARGEST = 252

#: Bytes of memory that a splat takes while it is read, beside its harmonics, of which a coefficient takes the second.
_SPLAT_BYTES, _HARMONIC_BYTES = 400, 40

#: Times better than others that pictures of splats on a lattice are packed.
_LEVEL = 4

#: Pixels that a picture may have beyond one for each splat: it is a rectangle, its sides rounded up.
_SPARE_PIXELS = 1 << 16

#: Gives the bytes of a file of the set by its name.
_Files = Callable[[str], bytes]


def has_sog_meta(path: pathlib.Path) -> bool:
    """Whether a meta.json describes splats."""
    try:
        content = read_json(path, "SOG file")
    except (ValueError, OSError):
        return False
    return {"means", "quats", "scales"} <= content.keys()


def read_sog(path: pathlib.Path) -> SplatContents:
    """The splats of a .sog archive, or of the folder of a meta.json. The axes are those of .ply files."""
    if path.name.lower() == META:
        return _read(path, _folder_meta(path), _folder_files(path))
    with zip_members(path, "a .sog file") as archive:
        inside = _archive_folder(archive)
        meta = _archive_meta(path, archive, inside)
        return _read(path, meta, lambda name: read_member(path, archive, inside + name, 1))


def write_sog(contents: SplatContents) -> bytes:
    """A .sog archive of version 2. The splats keep their order."""
    count, further = contents.count, contents.harmonics.shape[1] - 1
    pictures: dict[str, np.ndarray] = {}
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "warpcage"}, "count": count}
    if contents.antialias:
        meta["antialias"] = True
    places = contents.centers.astype(np.float64)
    logs = np.sign(places) * np.log1p(np.abs(places))
    low, high = (end(logs, axis=0) if count else np.zeros(3) for end in (np.min, np.max))
    span = np.where(high > low, high - low, 1.0)
    uint16s = np.round((logs - low) / span * 65535.0).astype(np.uint16)
    pictures["means_l.webp"], pictures["means_u.webp"] = uint16s & 255, uint16s >> 8
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    codes = codebook(contents.log_scales)
    pictures["scales.webp"] = nearest(codes, contents.log_scales)
    meta["scales"] = {"codebook": codes.tolist(), "files": ["scales.webp"]}
    others, largest = without_largest(contents.quaternions)
    turns = np.round(255.0 * (others / np.sqrt(2.0) + 0.5))
    pictures["quats.webp"] = np.column_stack([turns, _LARGEST + largest])
    meta["quats"] = {"files": ["quats.webp"]}
    codes = codebook(contents.harmonics[:, 0])
    alphas = np.round(255.0 * opacities_of(contents.logits))
    pictures["sh0.webp"] = np.column_stack([nearest(codes, contents.harmonics[:, 0]), alphas])
    meta["sh0"] = {"codebook": codes.tolist(), "files": ["sh0.webp"]}
    if further and count:
        entries, labels = palette(contents.harmonics[:, 1:].reshape(count, -1), _MAX_ENTRIES)
        codes = codebook(entries)
        names = ["shN_centroids.webp", "shN_labels.webp"]
        rows = -(-len(entries) // _ROW)
        cells = np.zeros((rows * _ROW, further, 3), np.uint8)
        cells[: len(entries)] = nearest(codes, entries).reshape(-1, further, 3)
        pictures[names[1]] = np.column_stack([labels & 255, labels >> 8, np.zeros(count)])
        bands = DEGREES[1 + further]
        meta["shN"] = {"count": len(entries), "bands": bands, "codebook": codes.tolist(), "files": names}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        _put(archive, META, json.dumps(meta).encode())
        for name, values in pictures.items():
            _put(archive, name, _picture_bytes(_as_picture(values)))
        if "shN" in meta:
            _put(archive, "shN_centroids.webp", _picture_bytes(cells.reshape(rows, _ROW * further, 3)))
    return packed.getvalue()


def position_step(contents: SplatContents) -> float:
    """From one position of a file to the next at the usual place, world units: the largest of the three axes."""
    if not contents.count:
        return 0.0
    places = np.abs(contents.centers.astype(np.float64))
    span = np.ptp(np.sign(contents.centers) * np.log1p(places), axis=0)
    return float((span / 65535.0 * (1.0 + np.median(places, axis=0))).max())


def _put(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file, with the same time in all archives, so that equal splats are equal files."""
    archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)


def _as_picture(values: np.ndarray) -> np.ndarray:
    """(h, w, c) uint8 pixels of values (n, c), row by row, the sides multiples of four."""
    count, channels = values.shape
    width = max(4, 4 * -(-int(np.ceil(np.sqrt(count))) // 4))
    height = max(4, 4 * -(-count // (4 * width)))
    pixels = np.zeros((height * width, channels), np.uint8)
    pixels[:count] = np.clip(values, 0, 255)
    if channels == 4:
        pixels[count:, 3] = 255
    return pixels.reshape(height, width, channels)


def _picture_bytes(pixels: np.ndarray) -> bytes:
    """A picture as lossless WebP, the colours of transparent pixels kept."""
    from PIL import Image

    packed = io.BytesIO()
    Image.fromarray(pixels).save(packed, "WEBP", lossless=True, exact=True, quality=90, method=4)
    return packed.getvalue()


def _folder_meta(path: pathlib.Path) -> dict[str, Any]:
    """The meta.json of a folder."""
    try:
        return read_json(path, "SOG file")
    except MemoryShortage:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _folder_files(path: pathlib.Path) -> _Files:
    """The files beside a meta.json."""
    folder = path.parent.resolve()

    def read(name: str) -> bytes:
        file = path.parent / name
        if not file.resolve().is_relative_to(folder):
            raise InputError(f"{path}: its file {shown(name)} leads out of the folder")
        if not file.is_file():
            raise InputError(f"{path}: its file {shown(name)} is not there")
        return read_limited(file, "picture")

    return read


def _archive_folder(archive: zipfile.ZipFile) -> str:
    """The one folder of an archive that was made of a folder, with a slash; "" where the files are at its top."""
    found = [name for name in archive.namelist() if name.count("/") == 1 and name.endswith(f"/{META}")]
    return found[0].removesuffix(META) if len(found) == 1 and META not in archive.namelist() else ""


def _archive_meta(path: pathlib.Path, archive: zipfile.ZipFile, inside: str) -> dict[str, Any]:
    """The meta.json of an archive."""
    data = read_member(path, archive, inside + META, JSON_ROOM, _MAX_META)
    try:
        meta = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # a number of thousands of digits is a ValueError too
        raise InputError(f"{path}: its {META} is damaged: {' '.join(str(error).split())}") from None
    if not isinstance(meta, dict):
        raise InputError(f"{path}: its {META} holds no JSON object")
    return meta


def _read(path: pathlib.Path, meta: dict[str, Any], files: _Files) -> SplatContents:
    """The splats that a meta.json describes."""
    try:
        version = meta.get("version", 1)
        if version not in (1, 2):
            raise InputError(f"{path}: SOG of version 1 and 2 is read, this is version {shown(version)}")
        return _SogReader(path, meta, files, version).read()
    except (*DAMAGED, IndexError) as error:
        raise InputError(f"{path}: {damage('SOG file', error)}") from None


class _SogReader:
    """Reads one set of pictures."""

    def __init__(self, path: pathlib.Path, meta: dict[str, Any], files: _Files, version: int):
        self.path, self.meta, self.files, self.version = path, meta, files, version
        count = meta["count"] if version == 2 else meta["means"]["shape"][0]
        self.count = checked_whole(count, f"{path}: its number of splats", 0)

    def read(self) -> SplatContents:
        """The splats."""
        count, meta = self.count, self.meta
        require_packed(self.path, count, len(self._file("means", 0)), f"its {count} splats", _LEVEL)
        require_host_memory(_SPLAT_BYTES * count, f"{self.path}: its {count} splats need")
        low, high = self._numbers("means", "mins", 3), self._numbers("means", "maxs", 3)
        uint16s = (
            self._pixels("means", 0)[:, :3].astype(np.uint32) | self._pixels("means", 1)[:, :3].astype(np.uint32) << 8
        )
        with np.errstate(over="ignore", invalid="ignore"):  # found by the check of what is finite
            logs = low + (high - low) * (uint16s / 65535.0)
            centers = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)
        turns = self._pixels("quats", 0)
        largest = turns[:, 3].astype(int) - _LARGEST
        quaternions = with_largest((turns[:, :3] / 255.0 - 0.5) * np.sqrt(2.0), np.maximum(largest, 0))
        quaternions[largest < 0] = [1.0, 0.0, 0.0, 0.0]
        colors = self._pixels("sh0", 0)
        if self.version == 2:
            logits = byte_logits(colors[:, 3])
        else:
            logits = self._ranged("sh0", colors, 4)[:, 3]
        first = self._decoded("sh0", colors[:, :3], 4)
        further = self._further() if meta.get("shN") else np.zeros((count, 0, 3), np.float32)
        return SplatContents(
            centers,
            self._decoded("scales", self._pixels("scales", 0)[:, :3], 3),
            quaternions.astype(np.float32),
            logits.astype(np.float32),
            np.concatenate([first[:, None, :3], further], axis=1),
            antialias=meta.get("antialias") is True,
        )

    def _further(self) -> np.ndarray:
        """(n, b - 1, 3) the harmonics after the first: each splat has those of an entry of a palette."""
        entry = self.meta["shN"]
        data = self._file("shN", 0)
        width, height = _picture_size(self.path, data)
        coefficients = width // _ROW
        if width % _ROW or coefficients not in (3, 8, 15):
            raise InputError(f"{self.path}: a palette of harmonics is 192, 512 or 960 pixels wide, got {width}")
        if self.version == 2 and entry["bands"] != DEGREES[1 + coefficients]:
            raise InputError(
                f"{self.path}: {shown(entry['bands'])} bands of harmonics do not fit a palette {width} pixels wide"
            )
        if height * _ROW > 2 * _MAX_ENTRIES:
            raise InputError(
                f"{self.path}: a palette of harmonics has at most {_MAX_ENTRIES} entries, got {height * _ROW}"
            )
        require_host_memory(_HARMONIC_BYTES * coefficients * self.count, f"{self.path}: its harmonics need")
        codes = _decoded_picture(self.path, data)[..., :3].reshape(height * _ROW, coefficients, 3)
        labels = self._pixels("shN", 1)
        of = labels[:, 0].astype(int) | labels[:, 1].astype(int) << 8
        entries = entry["count"] if self.version == 2 else height * _ROW
        if not isinstance(entries, int) or isinstance(entries, bool) or not 0 <= entries <= height * _ROW:
            raise InputError(f"{self.path}: a palette of {shown(entries)} entries does not fit {height} rows of {_ROW}")
        outside = of >= entries
        if outside.any():
            warn_caller(f"{self.path}: {int(outside.sum())} splats name harmonics that are not there: they have none")
        values = (
            self._decoded("shN", codes, 0)[np.where(outside, 0, of)]
            if entries
            else np.zeros((self.count, coefficients, 3))
        )
        values[outside] = 0.0
        return values.astype(np.float32)

    def _decoded(self, name: str, codes: np.ndarray, width: int) -> np.ndarray:
        """Values of bytes: from the codebook of version 2, or between the ends of version 1, `width` of them or one."""
        if self.version == 2:
            book = np.zeros(CODES)
            entry = self._numbers(name, "codebook", None)
            if len(entry) > CODES:
                raise InputError(f"{self.path}: a codebook has at most {CODES} numbers, that of {name} {len(entry)}")
            book[: len(entry)] = entry
            if codes.size and codes.max() >= len(entry):
                raise InputError(f"{self.path}: the codebook of {name} has {len(entry)} numbers, not {codes.max() + 1}")
            return book[codes].astype(np.float32)
        return self._ranged(name, codes, width)

    def _ranged(self, name: str, codes: np.ndarray, width: int) -> np.ndarray:
        """Values of bytes (..., c) between the ends that version 1 gives, of which c are used."""
        low, high = (self._numbers(name, end, width or 1) for end in ("mins", "maxs"))
        used = slice(None, codes.shape[-1] if width else 1)
        with np.errstate(over="ignore", invalid="ignore"):
            return (low[used] + (high - low)[used] * (codes / 255.0)).astype(np.float32)

    def _numbers(self, name: str, key: str, width: int | None) -> np.ndarray:
        """(width,) float64 numbers of the meta.json; None is any."""
        entry = self.meta[name][key]
        entry = entry if isinstance(entry, list) else [entry]
        if not all(isinstance(each, int | float) and not isinstance(each, bool) for each in entry):
            raise InputError(f"{self.path}: {key} of {name} must be numbers")
        if width is not None and len(entry) != width:
            raise InputError(f"{self.path}: {key} of {name} must be {width} numbers, got {len(entry)}")
        return np.array(entry, np.float64)

    def _file(self, name: str, index: int) -> bytes:
        """The bytes of a picture."""
        files = self.meta[name]["files"]
        if not isinstance(files, list) or len(files) <= index:
            raise InputError(f"{self.path}: the files of {name} must be a list of {index + 1} or more names")
        file = files[index]
        if not isinstance(file, str) or not file or pathlib.PurePath(file).name != file or "\\" in file:
            raise InputError(f"{self.path}: the name of a file of {name} is no plain name: {shown(file)}")
        return self.files(file)

    def _pixels(self, name: str, index: int) -> np.ndarray:
        """(n, 4) uint8 the pixels of the splats in a picture."""
        data = self._file(name, index)
        width, height = _picture_size(self.path, data)
        if not self.count <= width * height <= 2 * self.count + _SPARE_PIXELS:
            raise InputError(f"{self.path}: a picture of {name} has {width} x {height} pixels for {self.count} splats")
        return _decoded_picture(self.path, data).reshape(-1, 4)[: self.count]


def _picture_size(path: pathlib.Path, data: bytes) -> tuple[int, int]:
    """Width and height of a picture, for whose pixels there is memory."""
    width, height = _opened_picture(path, data).size
    require_host_memory(12 * width * height, f"{path}: a picture of {width} x {height} pixels needs")
    return width, height


def _decoded_picture(path: pathlib.Path, data: bytes) -> np.ndarray:
    """(h, w, 4) uint8 pixels."""
    picture = _opened_picture(path, data)
    try:
        return np.array(picture.convert("RGBA"))
    except Exception as error:  # decoders raise of all kinds
        raise InputError(f"{path}: a picture of it cannot be read: {' '.join(str(error).split())}") from None


def _opened_picture(path: pathlib.Path, data: bytes) -> Any:
    """A picture of which the header is read."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # its size is compared with the splats
            picture = Image.open(io.BytesIO(data), formats=("WEBP", "PNG"))
    except UnidentifiedImageError:
        raise InputError(f"{path}: a picture of it cannot be read: it is no WebP and no PNG picture") from None
    except Exception as error:  # decoders raise of all kinds
        raise InputError(f"{path}: a picture of it cannot be read: {' '.join(str(error).split())}") from None
    if picture.mode not in ("RGB", "RGBA"):
        raise InputError(f"{path}: a picture of it must have red, green and blue, got {picture.mode}")
    return picture
