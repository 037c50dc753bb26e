"""Files that a session makes: films, pictures with opacity, cages, poses, baked fields, and the command for a film."""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
import shlex
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ....cage.cage import Cage
from ....core.checks import checked_flag, checked_whole
from ....core.files import PathLike
from ....core.names import TRANSPARENT, named_errors
from ....deform.bake import bake
from ....deform.deformer import Deformer
from ....errors import InputError
from ....fitting.splats.from_voxels import to_splats
from ....splats.io.formats import format_to_write
from ....splats.splat_field import AnyField, SplatField, field_size
from ....view.camera import Camera
from ....view.pictures import picture_cuts, write_png
from ...spec.settings import Settings
from .. import film as films
from ..document import MAIN, Document
from ..folder import atomic_folder, checked_film_path
from ..overlap import BackgroundWriter
from ..render import Look, Scene
from ..video import checked_rate, require_clear_film, write_film
from .scene import Fields, PosedScene, is_filled, view_camera
from .timeline import document_at, frame_rate, frame_times, pose_file

#: Width and height of a film where none is given, and the largest, pixels.
DEFAULT_SIZE, LARGEST_SIDE = (800, 600), 8192

#: Kinds of cage files that a session writes; others can be read back too.
CAGE_ENDINGS = (".obj", ".ply", ".glb")

#: Gets how far the work is: a share from 0 to 1 or None, and what is done next. What it raises ends the work.
Report = Callable[[float | None, str], None]


@dataclasses.dataclass(frozen=True)
class Film:
    """How a film is written; its size is in pixels."""

    width: int = DEFAULT_SIZE[0]
    height: int = DEFAULT_SIZE[1]
    overlay: bool = False  # draw the cages of visible edits into the pictures
    transparent: bool = False  # with opacity instead of a background: for .mov, .webm and folders of PNG files

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            checked_whole(getattr(self, name), f"the {name} of a film", 1, LARGEST_SIDE)


def _silent(share: float | None, text: str) -> None:
    """Report nothing."""


def export_film(
    document: Document, field: AnyField | Fields, path: PathLike, film: Film | None = None, report: Report = _silent
) -> int:
    """Write the film of a document (or a new folder of PNG files), whole or not at all; returns the number of frames.
    What `report` raises ends the work."""
    # Frames show all visible edits as the timeline has them, at the document's settings; without keys all stands still.
    film = film or Film()
    target, times = checked_film_path(path), frame_times(document.timeline)
    ending = target.suffix.lower()
    if film.transparent:
        require_clear_film(target)
    rate = checked_rate(frame_rate(document.timeline), ending) if ending else None
    pictures = film_pictures(document, field, film, report)
    if rate is not None:
        write_film(target, pictures, rate, loop=document.timeline.loop != "once")
    else:
        with picture_cuts(target) as cuts, atomic_folder(target) as folder, BackgroundWriter() as beside:
            digits = max(4, len(str(len(times) - 1)))
            for index, picture in enumerate(pictures):
                path = folder / f"frame_{index:0{digits}d}.png"
                beside.run(functools.partial(write_png, path, picture, cuts=cuts), picture.nbytes)
    return len(times)


def film_shot(document: Document, field: AnyField, film: Film) -> Settings:
    """How the frames of a document's film are made; field: the session's own."""
    settings = document.settings
    background = TRANSPARENT if film.transparent else settings.background
    fill = not film.transparent and is_filled(document, field)
    return dataclasses.replace(settings, background=background, fill=fill, overlay=film.overlay, show="rgb")


def film_pictures(
    document: Document, field: AnyField | Fields, film: Film, report: Report = _silent
) -> Iterator[np.ndarray]:
    """The pictures of a film, each rendered when it is asked for: (height, width, 3 or 4) float32, read-only.
    Colours are not multiplied by opacity. Moments that look alike are one array."""
    times, settings = frame_times(document.timeline), dataclasses.replace(document.settings, mode="pose")
    document = dataclasses.replace(document, settings=settings)
    scene = PosedScene(field)  # with a Deformer of its own: the session's is in use

    def moment(frame: float) -> tuple[Scene, list[Cage]]:
        number = int(frame)
        report(number / len(times), f"frame {number + 1} of {len(times)}")
        now = document_at(document, times[number])
        with named_errors(f"at {times[number]:.3f} s of the film"):
            scene.prepare(now)
        cages = []
        for scene_object in now.objects:
            edits = [edit for edit in now.edits_of(scene_object.id) if edit.visible and edit.kind != "remove"]
            cages += [Cage(scene_object.place.moved(edit.posed), edit.faces) for edit in edits if scene_object.visible]
        return scene.stage or scene.posed(MAIN), cages

    def track(frames: Sequence[float]) -> list[Camera]:
        views = (document_at(document, times[int(frame)]).view for frame in frames)
        return [view_camera(view, film.width, film.height) for view in views]

    yield from films.Film(len(times), track, moment, Look.of(film_shot(document, scene.fields.main, film)))
    report(1.0, "finishes the file")


def export_cage(document: Document, number: int, path: PathLike, *, rest: bool = False) -> None:
    """Write the posed cage of an edit, or that at rest, whole or not at all; the ending is one of CAGE_ENDINGS."""
    edit, path = document.edit(number), pathlib.Path(path)
    if path.suffix.lower() not in CAGE_ENDINGS:
        raise InputError(f"cage {str(path)!r} must end in {', '.join(CAGE_ENDINGS)}")
    Cage(edit.rest if rest else edit.posed, edit.faces).save(path)


def export_poses(document: Document, number: int, path: PathLike) -> None:
    """Write the keys of an edit as a pose file (.json), whole or not at all."""
    if pathlib.Path(path).suffix.lower() != ".json":
        raise InputError(f"pose file {str(path)!r} must end in .json")
    pose_file(document, number).save(path)


def export_baked(document: Document, field: AnyField | Fields, path: PathLike, report: Report = _silent) -> AnyField:
    """Write the scene, deformed by the poses of now, as a field of its own, whole or not at all; returns that field.
    Without visible edits it is the field. A file of voxels ends in .npz. What `report` raises ends the work."""
    fields = Fields.of(field)
    kinds = {type(fields.field(one)) for one in document.objects if one.visible}
    if SplatField in kinds:
        format_to_write(path)
    elif pathlib.Path(path).suffix.lower() != ".npz":
        raise InputError(f"field {str(path)!r} must end in .npz")
    report(None, "poses the cages")
    scene = PosedScene(fields)
    scene.prepare(dataclasses.replace(document, settings=dataclasses.replace(document.settings, mode="pose")))
    report(0.1, "samples the posed scene")
    if scene.stage is not None:
        baked = scene.stage.merged(convert=to_splats)
    else:
        posed: Any = scene.posed(MAIN)
        baked = bake(posed) if isinstance(posed, Deformer) else posed
    report(0.8, f"writes {field_size(baked)}")
    baked.save(path)
    return baked


def export_command(
    session: PathLike, field: PathLike, film: Film | None = None, *, output: str = "film.mp4", scene_scale: float = 1.0
) -> str:
    """The command, one line for a shell, that makes the film of a session without the editor."""
    film = film or Film()
    paths = [os.fspath(path) for path in (field, session, output)]
    scene, kept, film_path = (f"./{path}" if path.startswith("-") else path for path in paths)  # else an option
    arguments = ["warpcage", "animate", scene, "--session", kept, "-o", film_path]
    arguments += ["--size", str(film.width), str(film.height)]
    arguments += ["--overlay"] * film.overlay + ["--transparent"] * film.transparent
    arguments += ["--scene-scale", repr(float(scene_scale))] * (scene_scale != 1.0)
    return shlex.join(arguments)


def requested_film(message: dict[str, Any]) -> Film:
    """Size and kind of a film's pictures."""
    options = {name: message[name] for name in ("width", "height") if message.get(name) is not None}
    flags = {name: checked_flag(message.get(name, False), name) for name in ("overlay", "transparent")}
    return Film(**options, **flags)
