"""Job files: items line by line, their defaults, and fingerprints of items, by which a changed input is known."""

from __future__ import annotations

import array
import collections
import functools
import hashlib
import json
import os
import pathlib
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from ...cage.presets import is_preset
from ...core.checks import checked_flag, listed, shown, warn_caller
from ...core.files import JSON_ROOM, PathLike, atomic_path, file_stamp, require_file, require_version, seen_note
from ...core.memory import LRUCache, require_host_memory
from ...core.names import checked_choice, older_keys, renamed_keys
from ...core.npz import NpyFile
from ...core.spec import checked_keys, one_of, whole
from ...edits.spec import canonical, split_reference
from ...errors import InputError
from ...package import WITHOUT_OLD_NAMES
from .items import FOLDER, WEBDATASET, Defaults, FrameItem, Item, checked_item, record_outputs


def _no_constant(name: str) -> Any:
    raise InputError(f"{name} is not a number in JSON")


_DECODER = json.JSONDecoder(parse_constant=_no_constant)


def item_of_line(path: str, defaults: Defaults, records: Mapping[str, Any], data: bytes, line: int) -> Item:
    """The item of a line of a job file, with what it takes from the header; path, line: for messages, from 1."""
    entry = parsed_line(data, f"{path}, line {line}")
    try:
        return checked_item(entry, defaults, records)
    except ValueError as error:
        name = f" ({shown(entry['id'])})" if isinstance(entry.get("id"), str) else ""
        raise InputError(f"{path}, line {line}{name}: {error}") from None


#: Makes an item of a line and its number, in any process.
ItemReader = Callable[[bytes, int], Item]


def parsed_line(data: bytes, where: str, *, first: bool = False) -> dict[str, Any]:
    """The JSON object of a line; where: file and line, for messages.
    first: whether it is the first of its file, which may begin with a mark of its encoding."""
    try:
        content = _DECODER.decode(data.decode("utf-8-sig" if first else "utf-8"))
        if isinstance(content, dict):
            return content
        wrong = f"it must be a JSON object, got {shown(content)}"
    except UnicodeDecodeError:
        wrong = "it holds no text (UTF-8)"
    except RecursionError:
        wrong = "its JSON is nested too deeply"
    except json.JSONDecodeError as error:
        wrong = f"its JSON breaks off or is damaged at column {error.colno}: every line is one whole object"
    except ValueError as error:  # NaN, or a number of too many digits
        wrong = str(error)
    raise InputError(f"{where}: {wrong}")


#: Version 2 has poses that are drawn, 3 moments of a shutter, 4 fragments, which older ones call crumbs. A file has the
#: first version that has all of its keys.
FORMAT, VERSION = "warpcage jobs", 4

#: Bytes that a line may have: a cage of a hundred thousand vertices takes a tenth of it.
MAX_LINE = 1 << 26

#: Bytes that are looked through at once for the ends of lines.
CHUNK = 1 << 22


class JobFile:
    """The items of a job file. Lines are read and checked when they are asked for; 8 bytes a line are held.
    A header, then an item a line, empty ones left out (docs/batch.md); paths are relative to the folder of the file."""

    def __init__(self, path: PathLike):
        self.path = require_file(path, "job file")
        self.folder = self.path.absolute().parent
        self._lock = threading.Lock()
        self._file = self.path.open("rb")
        try:
            self._starts, self._lines = self._found_lines()
            self.header = self._checked_header()
        except BaseException:
            self._file.close()
            raise
        self.defaults: dict[str, Any] = self.header.get("defaults") or {}
        self.records: dict[str, Any] = self.header.get("records") or {}  # how outputs are kept together
        if self.records:
            self.defaults = self.defaults | {"outputs": record_outputs(self.records)}
        defaults = Defaults(self.defaults)
        self.reader: ItemReader = functools.partial(item_of_line, str(self.path), defaults, self.records)

    def __enter__(self) -> JobFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._lines) - 1

    def __iter__(self) -> Iterator[Item]:
        """All items in their order. Raises ValueError at the first that cannot be read."""
        return map(self.item, range(len(self)))

    items = __iter__

    def close(self) -> None:
        self._file.close()

    def line(self, index: int) -> int:
        """The line, from 1, at which an item, from 0, stands."""
        return int(self._lines[index + 1]) + 1

    def item(self, index: int) -> Item:
        """An item by its number, from 0, with what it takes from the header."""
        if not 0 <= index < len(self):
            raise InputError(f"{self.path} has items 0 to {len(self) - 1}, got {index}")
        return self.reader(self.data(index), self.line(index))

    def data(self, index: int) -> bytes:
        """The line of an item, from 0, as it stands, for `reader`, in this process or another."""
        return self._data(int(self._lines[index + 1]))

    def check(self) -> None:
        """Check all lines, and that no two items share an id or a file; capitals count as small letters.
        16 bytes are held for each item and each output."""
        names = UniqueNames()
        for index, item in enumerate(self.items()):
            names.note(index, item)
        names.require(self)

    def _found_lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Where lines start (and the end of the file), and the numbers of those that hold something."""
        ends, place, blank = [np.zeros(1, np.int64)], 0, b" \t\r\n"
        while chunk := self._file.read(CHUNK):
            ends.append(np.flatnonzero(np.frombuffer(chunk, np.uint8) == 10) + (place + 1))
            place += len(chunk)
        starts = np.concatenate(ends)
        if starts[-1] != place:
            starts = np.append(starts, place)
        lengths = np.diff(starts)
        kept = np.ones(len(lengths), bool)
        for line in np.flatnonzero(lengths < 80):  # others hold more than a few spaces
            self._file.seek(int(starts[line]))
            kept[line] = bool(self._file.read(int(lengths[line])).strip(blank))
        lines = np.flatnonzero(kept).astype(np.int32)
        if not len(lines):
            raise InputError(f"{self.path} is empty: a job file begins with a header, {_HEADER_SHAPE}")
        return starts, lines

    def _data(self, line: int) -> bytes:
        """The bytes of a line, counted from 0."""
        start, end = int(self._starts[line]), int(self._starts[line + 1])
        where = f"{self.path}, line {line + 1}"
        if end - start > MAX_LINE:
            raise InputError(
                f"{where}: it has {end - start:,} bytes, at most {MAX_LINE:,} are read: put arrays into .npy files"
            )
        if end - start > CHUNK:
            require_host_memory(JSON_ROOM * (end - start), f"{where}: its {end - start} bytes need")
        with self._lock:
            self._file.seek(start)
            return self._file.read(end - start)

    def _checked_header(self) -> dict[str, Any]:
        line = int(self._lines[0])
        where = f"{self.path}, line {line + 1}"
        begins = f"; a job file begins with {_HEADER_SHAPE}"
        try:
            header = parsed_line(self._data(line), where, first=not line)
        except InputError as error:
            raise InputError(f"{error}{begins}{seen_note(self.path, 'JSON')}") from None
        if (found := header.get("format")) != FORMAT:
            wrong = f"it is not the header of a job file: its format is {shown(found)}, not {FORMAT!r}"
            raise InputError(f"{where}: {wrong}{begins}")
        try:
            require_version(header.get("version"), VERSION)
            if unknown := [key for key in header if key not in HEADER_KEYS]:
                raise InputError(f"a header has no {shown(unknown[0])}, only {', '.join(HEADER_KEYS)}")
            _check_defaults(header.get("defaults") or {})
            check_records(header.get("records") or {}, header.get("defaults") or {})
        except ValueError as error:
            raise InputError(f"{where}: {error}") from None
        return header


HEADER_KEYS = ("format", "version", "defaults", "records", "extra")

_HEADER_SHAPE = f'{{"format": "{FORMAT}", "version": 1}}'


class UniqueNames:
    """Ids and outputs of items, 64 bits of each, of which no two may be alike; capitals count as small letters."""

    def __init__(self) -> None:
        self._keys, self._owners = array.array("Q"), array.array("q")

    def note(self, index: int, item: Item) -> None:
        """Take in an item by its number in the job file."""
        for what, name in _names(item):
            mark = hashlib.blake2b(f"{what} {name}".encode(), digest_size=8).digest()
            self._keys.append(int.from_bytes(mark, "little"))
            self._owners.append(index)

    def require(self, job: JobFile) -> None:
        """Raise ValueError for the first item that has a name of one before it."""
        keys, owners = np.array(self._keys, np.uint64), np.array(self._owners, np.int64)
        order = np.argsort(keys, kind="stable")
        same = keys[order][1:] == keys[order][:-1]
        for two, one in sorted(zip(owners[order][1:][same].tolist(), owners[order][:-1][same].tolist(), strict=True)):
            names = collections.Counter(name for index in {one, two} for name in _names(job.item(index)))
            shared = [name for name, count in names.items() if count > 1]
            if shared:  # else two names have the same bits
                what, name = min(shared)
                lines = f"{job.path}, lines {job.line(one)} and {job.line(two)}"
                raise InputError(f"{lines}: two items have {what} {name!r}: each needs its own")


def _names(item: Item) -> list[tuple[str, str]]:
    """What it is called and what it writes. Capitals count as small letters, as on some file systems."""
    return [("the id", item.id.casefold()), *(("the output", path.casefold()) for path in item.outputs.values())]


def _check_defaults(defaults: Any) -> None:
    """Raise ValueError for defaults that no kind of item takes."""
    if not isinstance(defaults, dict):
        raise InputError(f"'defaults' must be an object of keys of items, got {shown(defaults)}")
    defaults = renamed_keys(defaults)
    kind = defaults.get("kind")
    if kind is not None:
        checked_choice(kind, "'kind' of 'defaults'", tuple(Item.kinds))
    known = {key: None for maker in Item.kinds.values() for key in maker.known() if key != "id"}
    for key, value in defaults.items():
        if key not in known:
            raise InputError(f"'defaults' has no {shown(key)}, only {listed(known, most=60)}")
        kinds = [Item.kinds[kind]] if kind is not None and key in Item.kinds[kind].known() else Item.kinds.values()
        checks, wrong = [each.known()[key] for each in kinds if key in each.known()], None
        for check in () if value is None else checks:
            try:  # one kind that takes the value is enough
                check(value, f"{key!r} of 'defaults'")
                wrong = None
                break
            except ValueError as error:
                wrong = error
        if wrong is not None:
            raise wrong


def check_records(records: Any, defaults: Mapping[str, Any]) -> None:
    """Check "records" of a header: how a job keeps its outputs together; defaults: "defaults" of the header."""
    if not isinstance(records, dict):
        raise InputError(f"'records' must be an object with a kind, got {shown(records)}")
    if not records:
        return
    known = {
        "kind": one_of(FOLDER, WEBDATASET).check,
        "items_per_shard": whole(1, 1_000_000).check,
        "image": one_of("png", "jpg").check,
        "depth": checked_flag,
        "alpha": checked_flag,
    }
    if "kind" not in checked_keys(records, known, "'records'"):
        raise InputError("'records' needs a 'kind': folder or webdataset")
    if defaults.get("outputs") is not None:
        raise InputError("'records' say what is written: leave 'outputs' of 'defaults' out")


def warn_of_shards(records: Mapping[str, Any]) -> None:
    """Warn where a job asks for records of kind "webdataset", which go."""
    if records.get("kind") == WEBDATASET:
        warn_caller(
            f"WebDataset records go with warpcage {WITHOUT_OLD_NAMES}: pack the folder of records with the webdataset "
            "package, see docs/sweeps.md"
        )


def write_jobs(
    path: PathLike,
    items: Iterable[Item | Mapping[str, Any]],
    *,
    defaults: Mapping[str, Any] | None = None,
    records: Mapping[str, Any] | None = None,
    extra: Any = None,
) -> int:
    """Write a job file, whole or not at all, of items that may come one by one, each checked; returns their number.
    records: how outputs are kept together, None is each file for itself; extra: any JSON that is kept in the header."""
    usual, records = dict(defaults or {}), dict(records or {})
    _check_defaults(usual)
    check_records(records, usual)
    warn_of_shards(records)
    complete = Defaults(usual | ({"outputs": record_outputs(records)} if records else {}))
    parts = {"defaults": usual, "records": records, "extra": extra}
    header = {"format": FORMAT, "version": 1} | {name: value for name, value in parts.items() if value}
    count, version = 0, _version_of(usual)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(_line(header))
        for count, item in enumerate(items, 1):
            entry = item.to_json() if isinstance(item, Item) else dict(item)
            try:
                checked_item(entry, complete, records)
                version = max(version, _version_of(entry))
                file.write(_line(entry))
            except ValueError as error:
                raise InputError(f"item {count} ({shown(entry.get('id'))}): {error}") from None
        file.seek(0)
        file.write(_line(header | {"version": version}))  # as long as it was: versions have one digit
    return count


def _version_of(entry: Mapping[str, Any]) -> int:
    """The first version that has all keys of checked defaults, or of a checked item."""
    edits = [renamed_keys(edit) for edit in (entry, *(entry.get("edits") or ()))]
    if any(edit.get("fragments") for edit in edits):
        return 4
    if entry.get("moments"):
        return 3
    return 2 if any(isinstance(edit.get("posed"), dict) for edit in edits) else 1


def _line(entry: Mapping[str, Any]) -> str:
    return json.dumps(entry, separators=(", ", ": "), allow_nan=False, ensure_ascii=False) + "\n"


#: Bytes that are hashed at once, and files whose hashes are kept.
HASHED_AT_ONCE, MAX_FILES = 1 << 20, 200_000

#: Bytes of a hash.
HASH_BYTES = 16


class Fingerprints:
    """Hashes of items and their inputs. A file is read once while its size and its time stay the same.
    out: folder of a run, which is left out where it lies in a scene."""

    # What is hashed is the item's own JSON, with all that it takes from its file's defaults, and the contents of all
    # files that it names: of a row of a .npy file that row alone, of a scene the names and contents of its files.

    def __init__(self, base: PathLike, out: PathLike | None = None):
        self.base = pathlib.Path(base)
        self._out = None if out is None else os.path.realpath(out)
        self._hashes: LRUCache[str] = LRUCache(MAX_FILES)
        self._arrays: LRUCache[NpyFile] = LRUCache(32)

    def of(self, item: Item) -> str:
        """The fingerprint of an item, hexadecimal digits. A file that cannot be read counts as such."""
        # by the keys of the first version, so that runs that it began go on
        parts = [canonical(older_keys(item.to_json())), *self.of_inputs(item)]
        return hashlib.blake2b("\n".join(parts).encode(), digest_size=HASH_BYTES).hexdigest()

    def of_inputs(self, item: Item) -> tuple[str, ...]:
        """The fingerprints of what an item reads, whatever it says beside: one for each of `references_of`."""
        return tuple(self._of_reference(each) for each in references_of(item))

    def _of_reference(self, reference: str) -> str:
        name, place = split_reference(reference)
        try:
            path = self.base / name
            if path.is_dir():
                return self._of_folder(path)
            if place.isdigit() and name.lower().endswith(".npy"):
                return self._of_row(path, int(place))
            return self._of_file(path)
        except (OSError, ValueError) as error:
            return f"cannot be read: {type(error).__name__}"

    def _of_file(self, path: pathlib.Path) -> str:
        """The hash of a file, and of the files beside it that a .gltf keeps its numbers in."""
        found = self._hashes.get((os.fspath(path), file_stamp(path)), lambda: file_hash(path))
        if path.suffix.lower() == ".gltf":
            return " ".join([found, *(self._of_file(each) for each in _gltf_files(path))])
        return found

    def _of_row(self, path: pathlib.Path, index: int) -> str:
        array = self._arrays.get((os.fspath(path), file_stamp(path)), lambda: NpyFile(path))
        row = hashlib.blake2b(array.row_data(index), digest_size=HASH_BYTES).hexdigest()
        return f"{array.dtype.str} {array.shape[1:]} {row}"

    def _of_folder(self, folder: pathlib.Path) -> str:
        """The hash of a folder: names and contents of what is in it, hidden files and the run's own left out."""
        lines = [f"{path.relative_to(folder).as_posix()} {self._of_file(path)}" for path in self._files_in(folder)]
        return hashlib.blake2b("\n".join(lines).encode("utf-8", "surrogateescape"), digest_size=HASH_BYTES).hexdigest()

    def _files_in(self, folder: pathlib.Path) -> Iterator[pathlib.Path]:
        seen: set[str] = set()
        for place, folders, files in os.walk(folder, followlinks=True):
            real = os.path.realpath(place)
            if real in seen or real == self._out:  # a link that leads back
                folders.clear()
                continue
            seen.add(real)
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for name in sorted(files):
                path = pathlib.Path(place, name)
                if not name.startswith(".") and path.is_file():
                    yield path


def references_of(item: Item) -> list[str]:
    """What an item reads, relative to the folder of its file: files, rows of arrays ("poses.npy#17"), folders of
    scenes."""
    values = [getattr(item, name, None) for name in ("field", "camera", "scene", "cameras")]
    if isinstance(item, FrameItem):
        for edit in item.edits:
            values += [*(edit.cage.values() if isinstance(edit.cage, dict) else [edit.cage]), edit.posed]
        for moment in item.moments:
            values += [moment.get("camera"), *(moment.get("posed") or ())]
    return [value for value in values if value and isinstance(value, str)]


def file_hash(path: pathlib.Path) -> str:
    """The hash of a file's bytes, hexadecimal digits."""
    found = hashlib.blake2b(digest_size=HASH_BYTES)
    with path.open("rb") as file:
        while chunk := file.read(HASHED_AT_ONCE):
            found.update(chunk)
    return found.hexdigest()


def _gltf_files(path: pathlib.Path) -> list[pathlib.Path]:
    """The files that a .gltf names beside it."""
    try:
        buffers = json.loads(path.read_bytes()).get("buffers", [])
        names = [each["uri"] for each in buffers if not each.get("uri", "data:").startswith("data:")]
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
        return []
    return [path.parent / name for name in names if (path.parent / name).is_file()]


#: Files that are remembered: each is looked at once, however many items name it.
MAX_KNOWN = 100_000


class Missing:
    """Looks for files and rows that items name; base: folder that their paths are relative to."""

    def __init__(self, base: PathLike):
        self.base, self._file = base, functools.lru_cache(MAX_KNOWN)(self._looked_at)

    def of(self, item: Item) -> str | None:
        """One line on the first that an item names and is not there; None where all is there."""
        return next(filter(None, map(self._wrong, references_of(item))), None)  # whether it can be used shows later

    def _wrong(self, reference: str) -> str | None:
        name, place = split_reference(reference)
        file = self._file(name)
        if isinstance(file, str):
            return file
        rows = file.shape[0] if file is not None and file.shape else 0
        if file is None or not place.isdigit() or int(place) < rows:
            return None
        return f"{file.path} has rows 0 to {rows - 1}, got {place}" if rows else f"{file.path} has no rows"

    def _looked_at(self, name: str) -> NpyFile | str | None:
        """The array in a .npy file, None for another that is there, or a line on what is wrong."""
        path = os.path.join(self.base, name)
        try:
            if os.path.isdir(path) or is_preset(name, self.base):
                return None
            return NpyFile(path) if name.lower().endswith(".npy") else require_file(path, "file") and None
        except (OSError, ValueError) as error:
            return str(error)
