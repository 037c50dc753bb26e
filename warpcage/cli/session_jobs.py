"""The film of a session of the editor as a job."""

from __future__ import annotations

import os
from collections.abc import Iterator

from ..batch.items import ID
from ..batch.words import TRANSPARENT
from ..editor.document import Document
from ..editor.exports import Film
from ..editor.renderer import camera
from ..editor.timeline import document_at, frame_rate, frame_times
from ..field.voxel_field import VoxelField
from .film_jobs import FilmFrame, FilmJob


def session_job(
    document: Document, field: VoxelField, film: Film, path: str | os.PathLike, scene_scale: float = 1.0
) -> tuple[FilmJob, Iterator[FilmFrame]]:
    """The job of a session's film, and its frames, which are those of `editor.exports.film_pictures`.
    path: the field's file; scene_scale: as the field was loaded."""
    if film.overlay:
        raise ValueError("--jobs of a session draws no cages: leave --overlay out")
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
            yield FilmFrame(index, camera(moment.view, film.width, film.height), poses)

    given = {name: value for name, value in words.items() if value is not None}
    extra = {"film": {"frames": len(times), "fps": str(rate)}}
    return FilmJob(path, given, [edit.cage_edit for edit in edits], extra), frames()
