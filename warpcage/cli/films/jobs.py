"""Films as job files: the items of their frames, and the arrays of their edits."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import os
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import IO, Any

import numpy as np

from ...batch.items import ID
from ...batch.job_file import write_jobs
from ...core.files import PathLike, atomic_path
from ...core.names import FRAGMENTS_WORD, TRANSPARENT
from ...editor.document import Document
from ...editor.exports import Film
from ...editor.pictures.scene import view_camera
from ...editor.timeline import document_at, frame_rate, frame_times
from ...edits.edits import CageEdit
from ...errors import InputError, StateError
from ...field.voxel_field import VoxelField
from ...view.camera import Camera, CameraKey, camera_json
from .. import shared
from ..arguments import options

#: Endings of job files.
JOB_ENDINGS = (".jsonl", ".json")


@dataclasses.dataclass(frozen=True)
class FilmFrame:
    """A frame of a film."""

    index: int
    camera: Camera
    poses: Sequence[np.ndarray | None] = ()  # of each edit the posed vertices, (v, 3) world units; None: it removes

    @property
    def name(self) -> str:
        """The id of its item, and the name of its picture without an ending."""
        return f"frame_{self.index:04d}"


@dataclasses.dataclass(frozen=True)
class FilmJob:
    """What all frames of a film share."""

    field: PathLike
    words: dict[str, Any]  # of items, for all frames: how they are rendered, and "outputs"
    edits: Sequence[CageEdit] = ()
    extra: Any = None  # any JSON, kept in the header of the job file

    def write(self, path: PathLike, frames: Iterable[FilmFrame]) -> int:
        """Write the job file, and beside it arrays of each cage at rest, its faces and poses; returns how many frames.
        They are taken one by one, equal poses are written once; a field in the job's folder is named from there."""
        path = pathlib.Path(path)
        with contextlib.ExitStack() as files:  # arrays take their places after the job file, or not at all
            cages = [
                _EditArrays(edit, path.with_name(f"{path.stem}{number}"), files)
                for edit, number in zip(self.edits, _numbers(len(self.edits)), strict=True)
            ]
            usual = {"kind": "frame", "field": _reference(self.field, path.parent), **self.words}
            alone = len(cages) == 1
            defaults = usual | (cages[0].words if alone else {})

            def items() -> Iterator[dict[str, Any]]:
                for frame in frames:
                    posed = [cage.posed(pose) for cage, pose in zip(cages, frame.poses, strict=True)]
                    edits = {"edits": [cage.words | pose for cage, pose in zip(cages, posed, strict=True)]}
                    yield {
                        "id": frame.name,
                        **((posed[0] if alone else edits) if posed else {}),
                        "camera": camera_json(CameraKey(frame.camera)),
                        "extra": {"frame": frame.index},
                    }
                for cage in cages:
                    cage.close()

            return write_jobs(path, items(), defaults=defaults, extra=self.extra)


def film_words(args: argparse.Namespace, *, scale: tuple[float, float] | None, deformed: bool) -> dict[str, Any]:
    """The words of items for the options of `warpcage animate`, but "outputs"; the lattice of `args` is chosen already.
    scale: low and high disparity of pictures of depth and disparity."""
    if args.overlay and args.show != "rgb":
        raise InputError(f"items of jobs draw cages into colours alone: leave out --overlay, or --show {args.show}")
    words: dict[str, Any] = {
        "background": TRANSPARENT if shared.is_transparent(args) else args.background,
        "antialias": args.antialias,
        "disparity_scale": scale,
        "scene_scale": None if args.scene_scale == 1.0 else args.scene_scale,
    }
    if deformed:
        cells = shared.lattice_cells(args)
        words |= {
            "coordinates": args.coordinates,
            "resolution": "precise" if cells is None else cells,
            "density": args.density,
            "map": args.map,
            "fill": args.fill or None,
            "overlay": args.overlay or None,
        }
    return {name: value for name, value in words.items() if value is not None}


def checked_jobs_path(text: str) -> pathlib.Path:
    """The path of a job file, once it is clear that one can be written there. Raises ValueError otherwise."""
    return options.check_output(text, JOB_ENDINGS, "job file")


def _numbers(count: int) -> list[str]:
    return [""] if count == 1 else [f".{number}" for number in range(1, count + 1)]


def _reference(file: PathLike, folder: pathlib.Path) -> str:
    """A file as a job file in a folder names it: both can be moved together where one is below the other."""
    path, base = (pathlib.Path(os.path.abspath(each)) for each in (file, folder))
    return str(path.relative_to(base)) if path.is_relative_to(base) else str(path)


class _EditArrays:
    """The arrays of an edit: its cage at rest, and its poses, each of which is written once."""

    def __init__(self, edit: CageEdit, stem: pathlib.Path, files: contextlib.ExitStack):
        rest, faces, poses = (stem.with_name(f"{stem.name}.{part}.npy") for part in ("rest", "faces", "poses"))
        for path, array in ((rest, edit.cage.vertices), (faces, edit.cage.faces)):
            np.save(files.enter_context(atomic_path(path)), array, allow_pickle=False)
        self._poses = poses.name
        self._rows = None if edit.remove else _Rows(files.enter_context(atomic_path(poses)), edit.cage.vertices.shape)
        if self._rows is not None:
            files.callback(self._rows.close)
        self._known: dict[bytes, int] = {}
        self.words = {"cage": {"vertices": rest.name, "faces": faces.name}} | _edit_words(edit)

    def posed(self, vertices: np.ndarray | None) -> dict[str, str]:
        """The words of a pose."""
        if self._rows is None:
            return {}
        assert vertices is not None
        row = np.ascontiguousarray(vertices, np.float64)
        key = hashlib.blake2b(row.tobytes(), digest_size=16).digest()
        if key not in self._known:
            self._known[key] = self._rows.append(row)
        return {"posed": f"{self._poses}#{self._known[key]}"}

    def close(self) -> None:
        """Finish the file of poses."""
        if self._rows is not None:
            self._rows.close()


def _edit_words(edit: CageEdit) -> dict[str, Any]:
    """The words of an edit besides its cage and its pose, those that say nothing left out."""
    walls = edit.held if isinstance(edit.held, str) else list(edit.held)
    fading = {} if edit.remove or not edit.falloff else {"falloff": edit.falloff, "held": walls}
    words = {"keep": edit.keep_source, "remove": edit.remove, FRAGMENTS_WORD: edit.fragments, **fading}
    return {name: value for name, value in words.items() if value and value != "cut"}


class _Rows:
    """An .npy file of float64 that grows by a row at a time; its header is written again at the end."""

    def __init__(self, path: pathlib.Path, shape: tuple[int, ...]):
        self._shape, self._count = shape, 0
        self._file: IO[bytes] = path.open("r+b")
        self._start = self._write_header()

    def append(self, row: np.ndarray) -> int:
        """Write a row. Returns its number."""
        self._file.write(row.tobytes())
        self._count += 1
        return self._count - 1

    def close(self) -> None:
        """Say in the header how many rows there are."""
        if self._file.closed:
            return
        with self._file:
            self._file.seek(0)
            if self._write_header() != self._start:
                raise StateError("NumPy wrote a header of another length")

    def _write_header(self) -> int:
        # with room for the digits of a first axis that grows
        header = {"descr": "<f8", "fortran_order": False, "shape": (self._count, *self._shape)}
        np.lib.format.write_array_header_1_0(self._file, header)
        return self._file.tell()


def session_job(
    document: Document, field: VoxelField, film: Film, path: str | os.PathLike[str], scene_scale: float = 1.0
) -> tuple[FilmJob, Iterator[FilmFrame]]:
    """The job of a session's film, and its frames, which are those of `editor.exports.film_pictures`.
    path: the field's file; scene_scale: as the field was loaded."""
    if film.overlay:
        raise InputError("--jobs of a session draws no cages: leave --overlay out")
    settings, rate = document.settings, frame_rate(document.timeline)
    edits = [edit for edit in document.edits if edit.visible]
    words = {
        "background": TRANSPARENT if film.transparent else settings.background,
        "supersampling": settings.supersampling,
        "scene_scale": None if scene_scale == 1.0 else scene_scale,
        "outputs": {"rgb": f"{ID}.png"},
    }
    if edits:
        fills = settings.fill and words["background"] is None and field.background_model is not None
        words |= {
            "coordinates": settings.coordinates,
            "resolution": settings.resolution,
            "density": settings.density,
            "fill": fills or None,
        }
    times = frame_times(document.timeline)

    def frames() -> Iterator[FilmFrame]:
        for index, time in enumerate(times):
            moment = document_at(document, time)
            poses = [None if edit.kind == "remove" else edit.posed for edit in moment.edits if edit.visible]
            yield FilmFrame(index, view_camera(moment.view, film.width, film.height), poses)

    given = {name: value for name, value in words.items() if value is not None}
    extra = {"film": {"frames": len(times), "fps": str(rate)}}
    return FilmJob(path, given, [edit.cage_edit for edit in edits], extra), frames()
