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
from typing import Any

import numpy as np

from ...core.files import PathLike, atomic_path, file_stamp
from ...errors import MissingFileError
from .items import TRANSFORMS, WEBDATASET, FrameItem
from .job_file import JobFile
from .manifest import DONE, Manifest, OutputFolder, are_there, file_size

#: Folder of a run in which shards are made.
STAGES = ".warpcage/shards"

_STAGE = re.compile(r"shard-(\d{6,})")

#: Bytes that are copied at once.
CHUNK = 1 << 20


def shard_path(out: PathLike, shard: int) -> pathlib.Path:
    """The tar file of a shard, by its number from 0, whether it is there or not."""
    return pathlib.Path(out) / f"shard-{shard:06d}.tar"


def shard_stage(out: PathLike, shard: int) -> pathlib.Path:
    """The folder in which the records of a shard, by its number from 0, stand until they are packed."""
    # A shard has so many items, by their places in the job file, and is packed when the last of them is settled.
    return pathlib.Path(out) / STAGES / f"shard-{shard:06d}"


def staged_shards(out: PathLike) -> list[int]:
    """Numbers of the shards that have loose files, ascending: under way, or interrupted before they were packed."""
    folder = pathlib.Path(out) / STAGES
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    return sorted(int(found[1]) for name in names if (found := _STAGE.fullmatch(name)))


def shard_holds(out: PathLike, shard: int, outputs: Any) -> bool:
    """Whether all files of an item are in its shard, loose or packed, in the size that its record says.
    outputs: bytes by path, as the manifest has them."""
    stage, path = shard_stage(out, shard), shard_path(out, shard)
    packed = _packed_sizes(path, file_stamp(path)) if path.exists() else {}
    return are_there(outputs, lambda name: file_size(stage / name, packed.get(name, -1)))  # a loose file counts first


def pack_shard(out: PathLike, shard: int, records: Sequence[Mapping[str, Any]]) -> pathlib.Path | None:
    """Pack a shard: the loose files of its records, and of the shard as it was before what was not made anew.
    records: those done, in the job's order, with `outputs`: bytes by path; where there are none, no tar file: None."""
    # The tar file is replaced at once, and then the loose files are deleted: a kill at any moment leaves those, to be
    # packed again, or a whole shard. Files of a record stand beside each other; dates and owners are left out, so that
    # equal records make equal bytes. Records that failed are left out: a later call with them packs them too.
    target, stage = shard_path(out, shard), shard_stage(out, shard)

    def is_later(name: str) -> tuple[bool, str]:  # than the picture, so that readers show what they have soon
        return not name.endswith((".png", ".jpg")) or ".alpha." in name, name

    names = [name for record in records for name in sorted(record["outputs"], key=is_later)]
    if names:
        with contextlib.ExitStack() as held:
            before = held.enter_context(tarfile.open(target)) if target.exists() else None
            packed = {} if before is None else {member.name: member for member in before}
            temporary = held.enter_context(atomic_path(target))
            with temporary.open("wb") as file, tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as tar:
                for name in names:
                    add_files(tar, name, stage, before, packed)
    else:
        target.unlink(missing_ok=True)
    _packed_sizes.cache_clear()
    shutil.rmtree(stage, ignore_errors=True)
    return target if names else None


def shard_size(job: JobFile) -> int:
    """Items of a shard of a job; 0 where it has no shards."""
    if job.records.get("kind") != WEBDATASET:
        return 0
    return int(job.records.get("items_per_shard", 1000))


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


def add_files(
    tar: tarfile.TarFile,
    name: str,
    stage: pathlib.Path,
    before: tarfile.TarFile | None,
    packed: Mapping[str, tarfile.TarInfo],
) -> None:
    """Add a loose file, or one that was packed before."""
    info = tarfile.TarInfo(name)
    info.mode = 0o644
    try:
        file = (stage / name).open("rb")
    except FileNotFoundError:
        if before is None or name not in packed:
            raise MissingFileError(f"{name!r} is not there, neither in {str(stage)!r} nor packed") from None
        info.size = packed[name].size
        tar.addfile(info, before.extractfile(packed[name]))
        return
    with file:
        info.size = os.fstat(file.fileno()).st_size
        tar.addfile(info, file)


@functools.lru_cache(maxsize=4)
def _packed_sizes(path: pathlib.Path, stamp: tuple[int, int]) -> Mapping[str, int]:
    """Bytes of each file in a tar file with a stamp; empty where it cannot be read."""
    with contextlib.suppress(OSError, tarfile.TarError), tarfile.open(path) as tar:
        return {member.name: member.size for member in tar}
    return {}


#: What transforms.json calls the numbers of a camera, and its frames the parts of a record.
_INTRINSICS = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
_PATHS = {name: f"{name}_path" for name in ("depth", "alpha", "pose", "record")} | {"rgb": "file_path"}


def finish_folder(out: PathLike, job: JobFile, manifest: Manifest) -> list[pathlib.Path]:
    """Write transforms.json for the pictures of a run: one for all, and one in each folder of pictures for those in it.
    manifest: which items are done, others are left out. Returns the files; none where no item is done."""
    # Ids as of `warpcage sweep`, pose_000012/camera_003, put the pictures of one pose into a folder, a scene of its
    # own. Intrinsics are those of the first frame, a frame with others has its own. Frames are read one after another.
    out, folders = pathlib.Path(out), {".": array.array("q")}
    for index, item in enumerate(job):
        found = manifest.find(item.id) if isinstance(item, FrameItem) and "record" in item.outputs else None
        if found is not None and found["state"] == DONE:
            place = pathlib.PurePosixPath(item.outputs["rgb"]).parent.as_posix()
            for folder in {".", place}:
                folders.setdefault(folder, array.array("q")).append(index)
    return [_write(out, folder, _frames(out, folder, job, indices)) for folder, indices in folders.items() if indices]


def _frames(
    out: pathlib.Path, folder: str, job: JobFile, indices: Iterable[int]
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Intrinsics and frame of each item, its paths below a folder."""
    for index in indices:
        item = job.item(index)
        record = json.loads((out / item.outputs["record"]).read_text(encoding="utf-8"))
        files = {part: pathlib.PurePosixPath(path).relative_to(folder) for part, path in item.outputs.items()}
        paths = {name: f"./{files[part].as_posix()}" for part, name in _PATHS.items() if part in files}
        matrix = record["transform_matrix"]  # camera to world, +y up, -z forward
        posed = [edit["posed"] for edit in record.get("edits", ()) if "posed" in edit]
        frame = {
            "file_path": paths.pop("file_path"),
            "transform_matrix": matrix,
            **paths,
            "id": item.id,
            "posed": posed,
        }
        camera = record["camera"]
        intrinsics = {"camera_angle_x": float(2.0 * np.arctan(0.5 * camera["width"] / camera["fx"]))}  # radians
        intrinsics |= {name: camera[key] for name, key in _INTRINSICS.items()}
        yield intrinsics, frame if item.extra is None else frame | {"extra": item.extra}


def _write(out: pathlib.Path, folder: str, frames: Iterator[tuple[dict[str, Any], dict[str, Any]]]) -> pathlib.Path:
    path = out / folder / TRANSFORMS
    usual: dict[str, Any] = {}
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        for intrinsics, frame in frames:
            file.write(",\n" if usual else json.dumps(intrinsics)[:-1] + ', "frames": [\n')
            usual = usual or intrinsics
            own = {} if intrinsics == usual else intrinsics
            file.write(json.dumps(frame | own, ensure_ascii=False))
        file.write("\n]}\n")
    return path
