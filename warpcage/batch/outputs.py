"""Outputs of items: all files of one are written, or none."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import os
import pathlib
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from ..core.files import atomic_path

#: Folders of a run: files stand in the first until they are whole, and what is left there belongs to nobody once no
#: worker runs; the second holds the progress of fits, from which they go on.
PARTS, CHECKPOINTS = ".warpcage/parts", ".warpcage/checkpoints"

#: Writes an output to a file that is not yet in its place. Any thread may call it: it uses main memory alone, or takes
#: the turn of its device.
Writer = Callable[[pathlib.Path], object]


@dataclasses.dataclass(frozen=True)
class Made:
    """An item that is made, and not yet written."""

    # by the paths of its outputs
    writers: Mapping[str, Writer]
    # of main memory, that the writers hold
    held_bytes: int = 0


def write_outputs(writers: Mapping[str, Writer], out: pathlib.Path, parts: pathlib.Path) -> dict[str, int]:
    """Write files below `out`, all of them or none; returns their bytes by path.
    parts: folder for files that are not whole yet, on the same file system."""
    sizes: dict[str, int] = {}
    placed: list[pathlib.Path] = []
    # they are written in a folder of their own, and put into their places when all are whole
    with _part_names(writers, parts) as names:
        for path, write in writers.items():
            write(names[path])
            sizes[path] = names[path].stat().st_size
        try:
            for path in writers:
                _put(names[path], out / path)
                placed.append(out / path)
                del names[path]
        except BaseException:
            for each in placed:
                each.unlink(missing_ok=True)
            raise
    return sizes


def _put(part: pathlib.Path, path: pathlib.Path) -> None:
    """Put a whole file into its place, also where that is on another disk, to which a link in the folder leads."""
    try:
        try:
            os.replace(part, path)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            os.replace(part, path)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        with atomic_path(path) as temporary:
            shutil.copyfile(part, temporary)
        part.unlink()


@contextlib.contextmanager
def _part_names(paths: Mapping[str, Writer], parts: pathlib.Path) -> Iterator[dict[str, pathlib.Path]]:
    """A file's name in `parts` for each path, with its ending; those that nobody took out are removed at the end."""
    parts.mkdir(parents=True, exist_ok=True)
    stem = uuid.uuid4().hex
    names = {path: parts / f"{stem}-{number}{pathlib.PurePosixPath(path).suffix}" for number, path in enumerate(paths)}
    try:
        yield names
    finally:
        for name in names.values():
            with contextlib.suppress(OSError):
                name.unlink()


def write_array(path: pathlib.Path, array: np.ndarray) -> None:
    """Write a .npy file that is not yet in its place."""
    numbers = np.ascontiguousarray(array)
    if not numbers.size:
        path.write_bytes(array_data(numbers))
        return
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(numbers))
    with path.open("wb") as file:  # np.save's own way tells of a full disk without its error number
        file.write(head.getbuffer())
        file.write(numbers.data.cast("B"))


def array_data(array: np.ndarray) -> memoryview:
    """The bytes of a .npy file."""
    data = io.BytesIO()
    np.save(data, np.ascontiguousarray(array), allow_pickle=False)
    return data.getbuffer()
