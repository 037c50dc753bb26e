"""Records of a data set: transforms.json over those of a folder, and shards of WebDataset."""

from __future__ import annotations

import array
import contextlib
import functools
import json
import os
import pathlib
import re
import shutil
import tarfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ..core.files import PathLike, atomic_path
from ..errors import MissingFileError
from .items import ITEMS_PER_SHARD, TRANSFORMS, WEBDATASET, FrameItem
from .job_file import JobFile
from .manifest import DONE, OutputFolder

#: Folder of a run in which shards are made.
STAGES = ".warpcage/shards"

_STAGE = re.compile(r"shard-(\d{6,})")

#: Bytes that are copied at once.
CHUNK = 1 << 20


def shard_path(out: PathLike, shard: int) -> pathlib.Path:
    """The tar file of a shard, by its number from 0, whether it is there or not."""
    return pathlib.Path(out) / f"{_stem(shard)}.tar"


def shard_stage(out: PathLike, shard: int) -> pathlib.Path:
    """The folder in which the records of a shard, by its number from 0, stand until they are packed."""
    # A shard has so many items, by their places in the job file, and is packed when the last of them is settled.
    return pathlib.Path(out) / STAGES / _stem(shard)


def staged_shards(out: PathLike) -> list[int]:
    """Numbers of the shards that have loose files, ascending: under way, or interrupted before they were packed."""
    folder = pathlib.Path(out) / STAGES
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    return sorted(int(found[1]) for name in names if (found := _STAGE.fullmatch(name)))


def shard_holds(out: PathLike, shard: int, outputs: Any) -> bool:
    """Whether all files of an item are in its shard, loose or packed, in the size that its record says.
    outputs: bytes by path, as the manifest has them."""
    if not isinstance(outputs, dict) or not outputs:
        return False
    stage, packed = shard_stage(out, shard), _sizes(shard_path(out, shard))
    return all(_loose_size(stage / name, packed.get(name)) == size for name, size in outputs.items())


def _loose_size(path: pathlib.Path, otherwise: int | None) -> int | None:
    """The size of a loose file, which counts before a packed one."""
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return otherwise


def pack_shard(out: PathLike, shard: int, records: Sequence[Mapping[str, Any]]) -> pathlib.Path | None:
    """Pack a shard: the loose files of its records, and of the shard as it was before what was not made anew.
    records: those done, in the job's order, with `outputs`: bytes by path; where there are none, no tar file: None."""
    # The tar file is replaced at once, and then the loose files are deleted: a kill at any moment leaves those, to be
    # packed again, or a whole shard. Files of a record stand beside each other; dates and owners are left out, so that
    # equal records make equal bytes. Records that failed are left out: a later call with them packs them too.
    target, stage = shard_path(out, shard), shard_stage(out, shard)
    names = [name for record in records for name in _ordered(record["outputs"])]
    if names:
        with contextlib.ExitStack() as held:
            before = held.enter_context(_Members(target))
            temporary = held.enter_context(atomic_path(target))
            with temporary.open("wb") as file, tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as tar:
                for name in names:
                    add_files(tar, name, stage, before)
    else:
        target.unlink(missing_ok=True)
    _sizes_of.cache_clear()
    shutil.rmtree(stage, ignore_errors=True)
    return target if names else None


def shard_size(job: JobFile) -> int:
    """Items of a shard of a job; 0 where it has no shards."""
    if job.records.get("kind") != WEBDATASET:
        return 0
    return int(job.records.get("items_per_shard", ITEMS_PER_SHARD))


def span_of(job: JobFile, folder: OutputFolder) -> range:
    """Numbers of the items that a run looks at: all, or those of its part, which has whole shards."""
    return range(len(job)) if folder.part is None else folder.part.range(len(job), shard_size(job) or 1)


def read_shard(path: PathLike) -> Iterator[dict[str, bytes]]:
    """The records of a shard, as the `webdataset` package groups them: "__key__", and the bytes of each file by its
    ending."""
    record: dict[str, Any] = {}
    with tarfile.open(path) as tar:
        for member in tar:
            key, ending = split_key(member.name)
            if record and record["__key__"] != key:
                yield record
                record = {}
            opened = tar.extractfile(member)
            assert opened is not None
            record |= {"__key__": key, ending: opened.read()}
    if record:
        yield record


def split_key(name: str) -> tuple[str, str]:
    """Key and ending of a file in a shard: what is before and after the first dot behind its folders."""
    folder, slash, last = name.rpartition("/")
    stem, _, ending = last.partition(".")
    return folder + slash + stem, ending


def _stem(shard: int) -> str:
    return f"shard-{shard:06d}"


def _ordered(outputs: Mapping[str, Any]) -> list[str]:
    """The files of a record: its picture first, so that readers show what they have soon."""
    return sorted(outputs, key=lambda name: (not name.endswith((".png", ".jpg")) or ".alpha." in name, name))


def add_files(tar: tarfile.TarFile, name: str, stage: pathlib.Path, before: _Members) -> None:
    """Add a loose file, or a packed one."""
    info = tarfile.TarInfo(name)
    info.mode = 0o644
    try:
        file = (stage / name).open("rb")
    except FileNotFoundError:
        packed = before.find(name)
        if packed is None:
            raise MissingFileError(f"{name!r} is not there, neither in {str(stage)!r} nor packed") from None
        info.size, opened = packed.size, before.open(packed)
        tar.addfile(info, opened)
        return
    with file:
        info.size = os.fstat(file.fileno()).st_size
        tar.addfile(info, file)


class _Members:
    """What a tar file holds; nothing where there is none."""

    def __init__(self, path: pathlib.Path):
        self._tar = tarfile.open(path) if path.exists() else None
        self._members = {} if self._tar is None else {member.name: member for member in self._tar}

    def __enter__(self) -> _Members:
        return self

    def __exit__(self, *_: object) -> None:
        if self._tar is not None:
            self._tar.close()

    def find(self, name: str) -> tarfile.TarInfo | None:
        """A file in it."""
        return self._members.get(name)

    def open(self, member: tarfile.TarInfo) -> Any:
        """Its bytes."""
        assert self._tar is not None
        return self._tar.extractfile(member)


def _sizes(path: pathlib.Path) -> Mapping[str, int]:
    """Bytes of each file in a tar file; empty where there is none, or it cannot be read."""
    try:
        stat = path.stat()
    except OSError:
        return {}
    return _sizes_of(str(path), stat.st_size, stat.st_mtime_ns)


@functools.lru_cache(maxsize=4)
def _sizes_of(path: str, size: int, time: int) -> Mapping[str, int]:
    try:
        with tarfile.open(path) as tar:
            return {member.name: member.size for member in tar}
    except (OSError, tarfile.TarError):
        return {}


def camera_words(camera: Mapping[str, Any]) -> dict[str, Any]:
    """The intrinsics of a record's camera as transforms.json has them; pixels, and radians for the angle of view."""
    width, height, fx, fy = camera["width"], camera["height"], camera["fx"], camera["fy"]
    angle = 2.0 * np.arctan(0.5 * width / fx)
    return {"camera_angle_x": float(angle), "w": width, "h": height, "fl_x": fx, "fl_y": fy} | {
        name: camera[name] for name in ("cx", "cy")
    }


def beside(path: str, folder: str) -> str:
    """A path below the folder of a run as one below a folder in it."""
    return pathlib.PurePosixPath(path).relative_to(folder).as_posix()


#: What frames call the parts of a record.
_WORDS = {"depth": "depth_path", "alpha": "alpha_path", "pose": "pose_path", "record": "record_path"}


class Manifested(Protocol):
    """What knows which items of a run are done: `batch.manifest.Manifest`."""

    def find(self, item_id: str) -> Mapping[str, Any] | None:
        """The record of an item; None where there is none."""
        ...


def finish_folder(out: PathLike, job: JobFile, manifest: Manifested) -> list[pathlib.Path]:
    """Write transforms.json for the pictures of a run: one for all, and one in each folder of pictures for those in it.
    manifest: which items are done, others are left out. Returns the files; none where no item is done."""
    # Ids as of `warpcage sweep`, pose_000012/camera_003, put the pictures of one pose into a folder, a scene of its
    # own. Intrinsics are those of the first frame, a frame with others has its own. Frames are read one after another.
    out = pathlib.Path(out)
    folders: dict[str, array.array[int]] = {}
    everything = array.array("q")
    for index, item in enumerate(job.items()):
        found = manifest.find(item.id) if isinstance(item, FrameItem) and "record" in item.outputs else None
        if found is not None and found["state"] == DONE:
            everything.append(index)
            folders.setdefault(_folder(item.outputs["rgb"]), array.array("q")).append(index)
    if not everything:
        return []
    parts = {folder: indices for folder, indices in folders.items() if folder != "."}
    written = [_write(out, ".", _frames(out, ".", job, everything))]
    return written + [_write(out, folder, _frames(out, folder, job, indices)) for folder, indices in parts.items()]


def _folder(path: str) -> str:
    return pathlib.PurePosixPath(path).parent.as_posix()


def _frames(
    out: pathlib.Path, folder: str, job: JobFile, indices: Iterable[int]
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Intrinsics and frame of each item, its paths below a folder."""
    for index in indices:
        item = job.item(index)
        record = json.loads((out / item.outputs["record"]).read_text(encoding="utf-8"))
        frame = {
            "file_path": f"./{beside(item.outputs['rgb'], folder)}",
            "transform_matrix": record["transform_matrix"],  # camera to world, +y up, -z forward
        }
        frame |= {_WORDS[part]: f"./{beside(item.outputs[part], folder)}" for part in _WORDS if part in item.outputs}
        posed = [edit["posed"] for edit in record.get("edits", ()) if "posed" in edit]
        frame |= {"id": item.id, "posed": posed}
        yield camera_words(record["camera"]), frame if item.extra is None else frame | {"extra": item.extra}


def _write(out: pathlib.Path, folder: str, frames: Iterator[tuple[dict[str, Any], dict[str, Any]]]) -> pathlib.Path:
    path = out / folder / TRANSFORMS
    usual: dict[str, Any] | None = None
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        for intrinsics, frame in frames:
            if usual is None:
                usual = intrinsics
                file.write(json.dumps(usual)[:-1] + ', "frames": [\n')
            else:
                file.write(",\n")
            own = {} if intrinsics == usual else intrinsics
            file.write(json.dumps(frame | own, ensure_ascii=False))
        file.write("\n]}\n")
    return path
