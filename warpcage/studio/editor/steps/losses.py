"""What a step takes from the keys of a film, as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ....coordinates.coordinates import deform_points
from ....core.names import agreed, counted
from ...films.document import Document, Edit, Key

#: How far what is in a cage may come to lie elsewhere than before the cage was replaced, as a share of its size.
TOLERANCE = 1e-4

#: How far from the middle of its cage each vertex is looked at, to see whether another cage moves it alike.
WITHIN = 0.9

#: Keys before and after a step; None is deleted.
_Pairs = list[tuple[Key, Key | None]]


def losses(before: Document, after: Document) -> str | None:
    """One line of what keys no longer hold after a step, or hold roughly; None where they hold all of it."""
    there = {key.id: key for key in after.timeline.keys}
    pairs: _Pairs = [(key, there.get(key.id)) for key in before.timeline.keys if there.get(key.id) is not key]
    cages, names = {edit.id: edit for edit in before.edits}, {edit.id: f'"{edit.name}"' for edit in before.edits}
    moved = {edit.id for edit in after.edits if edit.id in cages and edit.rest is not cages[edit.id].rest}  # carried
    objects = {one.id: f'"{one.name}"' for one in before.objects}
    lost = [
        *_lost(pairs, ("pose", "poses"), "cages", lambda key: key.poses or {}, names, moved),
        *_lost(pairs, ("camera", "cameras"), "", lambda key: {} if key.view is None else {0: key.view}, {0: ""}),
        *_lost(pairs, ("position", "positions"), "objects", lambda key: key.places or {}, objects),
    ]
    lines = []
    if lost:
        count, what = lost[0]
        lose = agreed(count, "loses", "lose")
        others = [f", {counted(count, 'key')} {what}" for count, what in lost[1:]]
        lines.append(f"{counted(count, 'key')} {lose} {what}{''.join(others)}.")
    lines += [line for edit in after.edits if edit.id in moved and (line := _rough(cages[edit.id], edit, pairs))]
    return " ".join([*lines, "Undo brings that back."]) if lines else None


def _lost(
    pairs: _Pairs,
    nouns: tuple[str, str],
    several: str,
    held: Callable[[Key], Mapping[int, Any]],
    names: Mapping[int, str],
    carried: Iterable[int] = (),
) -> list[tuple[int, str]]:
    """How many keys lose something that they hold by number, and what, as text: first what is gone, then what was
    replaced. `nouns`: singular and plural of it; `several`: what is numbered."""
    found: dict[str, tuple[set[int], set[int]]] = {"": (set(), set()), "old ": (set(), set())}  # keys and numbers
    for key, now in pairs:
        new = {} if now is None else held(now)
        for number in held(key).keys() & names.keys():
            if number in new and (number in carried or np.array_equal(held(key)[number], new[number])):
                continue
            keys, numbers = found["old " if number in new else ""]
            keys.add(key.id)
            numbers.add(number)
    lost = []
    for old, (keys, numbers) in found.items():
        if keys:
            noun = nouns[max(len(keys), len(numbers)) > 1]
            name = names[min(numbers)] if len(numbers) == 1 else f"{len(numbers)} {several}"
            lost.append((len(keys), f"{agreed(len(keys), 'its', 'their')} {old}{noun}{name and f' of {name}'}"))
    return lost


def _rough(old: Edit, new: Edit, pairs: _Pairs) -> str | None:
    """One line where poses that keys hold fit an edit's new cage only roughly."""
    both = [(key.poses, now.poses) for key, now in pairs if key.poses and now and now.poses]
    carried = [(was[old.id], pose[old.id]) for was, pose in both if old.id in was and old.id in pose]
    if not carried or np.array_equal(old.faces, new.faces):
        return None
    finer = old.rest_cage.subdivide()
    if np.array_equal(finer.face_array, new.faces) and np.array_equal(finer.vertices, new.rest):
        return None
    off = max(_off(old, was, new, pose) for was, pose in carried)
    if off <= TOLERANCE:
        return None
    where = f"the poses of {counted(len(carried), 'key')}" if len(carried) > 1 else "the pose of 1 key"
    return f'The new cage of "{new.name}" takes {where} over roughly: up to {off:.1%} of its size off.'


def _off(old: Edit, was: np.ndarray, new: Edit, pose: np.ndarray) -> float:
    """How far apart two cages in a pose move what both hold at most, as a share of the first one's size."""
    points = np.concatenate([WITHIN * edit.rest + (1.0 - WITHIN) * edit.rest.mean(axis=0) for edit in (old, new)])
    try:
        points = points[old.rest_cage.contains(points, device="cpu") & new.rest_cage.contains(points, device="cpu")]
        ends = [
            deform_points(points, edit.rest_cage, edit.rest_cage.with_vertices(to), device="cpu")
            for edit, to in ((old, was), (new, pose))
        ]
    except ValueError:  # a cage that cannot be used
        return 1.0
    return float(np.abs(ends[0] - ends[1]).max(initial=0.0) / np.ptp(old.rest, axis=0).max()) if len(points) else 1.0
