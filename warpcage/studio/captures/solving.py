"""Which cameras are taken: two ways to find them, judged by the matches, and what is refused with pictures' names."""

from __future__ import annotations

import dataclasses
import pathlib
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...errors import InputError
from ...scene.camera_check import (
    MAX_NAMED,
    MAX_TORN,
    MIN_ACROSS,
    MIN_AGREEING,
    MIN_GROUP,
    MIN_PARALLAX,
    Agreement,
    agreement_of,
    ahead_share,
    group_names,
)
from ...view.camera import Camera
from .colmap import Found, Solver, found_of

#: Fewest pictures that cameras can be found of.
MIN_PICTURES = 3

#: Fewest points that hold the cameras of a picture together.
MIN_POINTS = 10

#: How pictures are taken that can be used, for messages.
HOW_TO = "walk around the object in small steps, so that each picture shows most of what the one before it did"

#: A match agrees where its rays miss each other by a pixel, of pictures so long at least, pixels.
ONE_PIXEL_OF = 800

#: From this share of matches that agree on a solution is taken as it is; below it, it is said, and one that is inside
#: out is refused; below `MIN_AGREEING`, any is. One inside out had 0.74.
GOOD_SHARE = 0.9


@dataclasses.dataclass(frozen=True)
class Solution:
    """Cameras and points of pictures, and what the matches say of them."""

    model: Any  # pycolmap.Reconstruction
    found: Found
    agreement: Agreement
    score: float  # share of all matches of the capture that agree, also of those of pictures without a camera
    ahead: float  # share of the cameras in front of which lies what all look at
    groups: list[list[str]]  # names of the files of groups that share no point, the largest first


def solve(
    solver: Solver, folder: pathlib.Path, source: pathlib.Path, labels: Sequence[str], kept: pathlib.Path
) -> Solution:
    """The best solution for matched pictures; ValueError for one that is wrong, or too little. folder: for COLMAP's own
    files; labels: what messages call the pictures; kept: where the solution is written, and found by a later call."""
    matches = solver.verified_matches()
    if kept.is_dir():
        return judged(solver, solver.colmap.Reconstruction(kept), matches)
    best: Solution | None = None
    for way in (solver.map_globally, solver.map):  # at once, and picture by picture
        found = _solved(solver, way, folder, matches)
        if found is not None and (best is None or found.score > best.score):
            best = found
        if best is not None and best.score >= GOOD_SHARE and 2 * len(best.found.pictures) > len(labels):
            break
    if best is not None:
        _require_whole(source, labels, best)
        _require_agreement(source, labels, best)
        best = _without_strays(solver, best, matches)
    _require_most(source, solver.names, labels, best)
    assert best is not None
    _require_parallax(source, best.found)
    unfinished = kept.with_name(f"{kept.name}.new")
    _emptied(unfinished)
    best.model.write(unfinished)
    unfinished.replace(kept)
    return best


def _solved(
    solver: Solver, way: Callable[[pathlib.Path], list[Any]], folder: pathlib.Path, matches: tuple
) -> Solution | None:
    _emptied(folder)
    models = way(folder)
    if not models or models[0].num_points3D() == 0:
        return None
    groups = [[image.name for image in model.images.values() if image.has_pose] for model in models]
    return judged(solver, solver.refine(models[0]), matches, groups)


def judged(solver: Solver, model: Any, matches: tuple, groups: Sequence[list[str]] = ()) -> Solution:
    """A pycolmap Reconstruction with what all matches, those of `Solver.verified_matches`, say of it."""
    places, pairs = matches
    found, images = found_of(model, solver.names), {image.name: image for image in model.images.values()}
    poses = np.full((len(places), 4, 4), np.nan)
    poses[found.pictures] = found.poses
    slopes, tolerances = list(places), np.ones(len(places))
    for picture, lens in zip(found.pictures, found.lenses, strict=True):
        camera = model.cameras[images[solver.names[picture]].camera_id]
        slopes[picture] = camera.cam_from_img(places[picture])
        tolerances[picture] = max(1.0, max(lens.size) / ONE_PIXEL_OF) / lens.intrinsics[0]
    agreement = agreement_of(slopes, pairs, poses, tolerances)
    total = sum(len(rows) for rows in pairs.values())
    cameras = [Camera(*lens.intrinsics, *lens.size, pose) for lens, pose in zip(found.lenses, found.poses, strict=True)]
    score = float(agreement.agreeing.sum()) / max(total, 1)
    return Solution(model, found, agreement, score, ahead_share(cameras), list(groups))


def _without_strays(solver: Solver, solution: Solution, matches: tuple) -> Solution:
    """A solution without the few pictures whose matches disagree with it, or that hardly any point holds."""
    found = solution.found
    strays = {int(picture) for group in solution.agreement.groups[1:] for picture in group}
    strays |= {int(picture) for picture in found.pictures[found.counts < MIN_POINTS]}
    if not strays or len(strays) == len(found.pictures):
        return solution
    model, names = solver.colmap.Reconstruction(solution.model), {solver.names[picture] for picture in strays}
    for image in list(model.images.values()):
        if image.name in names:
            model.deregister_frame(image.frame_id)
    apart = [[solver.names[picture] for picture in group] for group in solution.agreement.groups]
    return judged(solver, model, matches, apart if len(solution.groups) < 2 else solution.groups)


def worst_pictures(solution: Solution) -> np.ndarray:
    """The pictures with a camera, those first of whose matches the smallest share agrees."""
    agreement, pictures = solution.agreement, solution.found.pictures
    both = agreement.pairs.ravel()
    size = int(pictures.max(initial=0)) + 1
    total, good = (
        np.bincount(both, weights=np.repeat(part, 2), minlength=size) for part in (agreement.counts, agreement.agreeing)
    )
    return pictures[np.argsort(good[pictures] / np.maximum(total[pictures], 1), kind="stable")]


def _require_whole(source: pathlib.Path, labels: Sequence[str], solution: Solution) -> None:
    """Raises ValueError where a part of the pictures does not fit to the others, though they show the same."""
    agreement = solution.agreement
    first, *others = agreement.groups
    for group in others:
        total, good = agreement.across(group)
        if len(group) < max(MIN_GROUP, MAX_TORN * len(solution.found.pictures)):
            break  # they are ordered by size
        if total >= MIN_ACROSS * agreement.inside(group):
            torn, rest = (f"({group_names(labels, each)})" for each in (group, first))
            raise InputError(
                f"the cameras of {str(source)!r} do not fit together: {len(group)} pictures {torn} do not fit to the "
                f"other {len(first)} {rest}, of {total} matches between them {good} agree: capture one of these groups "
                "alone (--pictures), add pictures taken between them, or leave out what looks alike in several places"
            )


def doubts(solution: Solution, labels: Sequence[str]) -> list[str]:
    """Sentences of a report on cameras that the matches do not bear out as well as usual."""
    share = solution.agreement.share
    if share >= GOOD_SHARE:
        return []
    worst = ", ".join(labels[int(picture)] for picture in worst_pictures(solution)[:MAX_NAMED])
    return [
        (
            f"Only {100 * share:.0f} % of the matches agree with the cameras, which may be wrong in part, least those "
            f"of {worst}: look at what is fitted; what repeats itself, shines or moves misleads."
        )
    ]


def _require_agreement(source: pathlib.Path, labels: Sequence[str], solution: Solution) -> None:
    """Raises ValueError for cameras that are inside out, or that the matches of the pictures disagree with."""
    share = solution.agreement.share
    if share >= GOOD_SHARE or (share >= MIN_AGREEING and solution.ahead > 0.5):
        return
    worst = ", ".join(labels[int(picture)] for picture in worst_pictures(solution)[:MAX_NAMED])
    wrong = (
        "come out inside out: what all look at lies behind them, and"
        if solution.ahead <= 0.5
        else "do not fit to the pictures:"
    )
    raise InputError(
        f"the cameras of {str(source)!r} {wrong} only {100 * share:.0f} % of the matches agree with them, least those "
        f"of {worst}: leave these out (--pictures), add pictures from more sides in smaller steps, or give ones whose "
        "EXIF says the focal length"
    )


def _require_most(source: pathlib.Path, names: Sequence[str], labels: Sequence[str], solution: Solution | None) -> None:
    """Raises ValueError where fewer than half of the pictures have a camera, or next to nothing holds them."""
    count, groups = len(names), [] if solution is None else solution.groups
    most = 0 if solution is None else len(solution.found.pictures)
    label_of = dict(zip(names, labels, strict=True))
    if len(groups) > 1 and most >= MIN_GROUP and 2 * most < count + 1 and 2 * len(groups[1]) >= most:
        parts = "; ".join(
            f"{len(group)} with {label_of[min(group)]} and {label_of[max(group)]}"
            for group in sorted(groups, key=min)
            if 2 * len(group) >= most
        )
        raise InputError(
            f"the pictures of {str(source)!r} fall apart into groups that share nothing ({parts}): capture them one by "
            "one, or add pictures that show both"
        )
    if solution is None or most < MIN_PICTURES or 2 * most < count or len(solution.found.points) < MIN_POINTS * most:
        raise InputError(
            f"cameras were found of {most} of {count} pictures of {str(source)!r}, which is too few to go by: "
            f"{HOW_TO}; keep the object still, and avoid mirrors, glass and bare walls"
        )


def _require_parallax(source: pathlib.Path, found: Found) -> None:
    """Raises ValueError where all pictures were taken from about one place: they say nothing about depth."""
    places = found.poses[:, :3, 3]
    spread = float(np.linalg.norm(np.ptp(places, axis=0)))
    away = float(np.median(np.linalg.norm(found.points - places.mean(axis=0), axis=1)))
    if spread < MIN_PARALLAX * away:
        raise InputError(
            f"the pictures of {str(source)!r} were taken from about one place, {100 * spread / away:.0f} % of the way "
            f"to what they show apart, which says nothing about depth: do not turn the camera, {HOW_TO}"
        )


def _emptied(folder: pathlib.Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
