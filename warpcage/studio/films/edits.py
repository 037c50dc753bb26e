"""Edits of a scene with the poses that their cages go through: read from arguments and from edits files."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from ...cage.axes import with_up
from ...cage.cage import Cage
from ...cage.pose_file import PoseFile, cage_hash
from ...cage.presets import Preset, is_preset
from ...core.files import PathLike, atomic_path, path_from, read_document, require_file
from ...edits.edits import MAX_EDITS, CageEdit, edit_from_spec
from ...edits.spec import EditSpec
from ...errors import InputError
from ...splats.splat_field import AnyField
from ...view.motion import value_along
from .motion import pose_along
from .resolve import expected_ups, only_pose, read_film, read_poses, read_rest


class Keyframes:
    """A cage at rest, the poses that follow it, and all poses between them."""

    def __init__(
        self,
        rest: Cage,
        texts: list[str],  # values of --posed, in order
        interpolation: str,  # "smooth" or "linear"
        up: str | None = None,  # "y" or "z"; None finds it from the rest cage, file by file
        expected: Mapping[str, str] | None = None,  # axis by ending of cage files where nothing speaks for another
        *,
        timed: bool = False,  # poses that have times make a film of their own: see `read_film`
        fps: Fraction | None = None,  # rate of numbered cage files in such a film; None is the usual one
    ):
        self.rest, self.interpolation = rest, interpolation
        self.preset: Preset | None = None  # whose amount is interpolated
        self.amounts: list[tuple[float, ...]] = []  # one per cage
        self.film = read_film(rest, texts, up, expected, fps) if timed else None  # None: the poses follow evenly
        if self.film is not None:
            self.cages = [rest, *(self.film[name] for name in self.film.timed)]
            for name in self.film.timed:
                self.film[name].require_usable(f"keyframe {name!r} of {texts[0]!r}")
            return
        likely = expected_ups(rest, texts, expected) if up is None else None
        self.cages = [rest] + [pose for text in texts for pose in read_poses(rest, text, up, expected=likely)]
        presets = [Preset(text) for text in texts if is_preset(text)]
        moving = [preset for preset in presets if preset.kind != "rest"]
        if len(presets) == len(texts) and len({preset.family for preset in moving}) == 1:
            self.preset = moving[0]
            still = (self.preset.neutral,) * len(self.preset.amount)
            self.amounts = [still] + [still if preset.kind == "rest" else preset.amount for preset in presets]

    def at(self, place: float) -> Cage:
        """The cage at a place: 0 at rest, 1 the first pose, and so on, or between them."""
        # Each vertex by itself; of one preset with different amounts the amount, so that a bend stays an arc.
        if self.preset is None:
            return pose_along(self.cages, place, self.interpolation)
        amount = value_along([np.array(amount) for amount in self.amounts], place, self.interpolation)
        return self.preset.at(self.rest, amount.tolist())

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) vertices of all cages, world units."""
        return np.concatenate([cage.vertices for cage in self.cages])


@dataclasses.dataclass(frozen=True)
class PosedEdit:
    """One edit, and the poses that its cage goes through (None for an edit that removes)."""

    edit: CageEdit
    keyframes: Keyframes | None

    def at(self, place: float) -> Cage | None:
        """The cage at a place, 0 at rest and 1 the first pose; after its last pose it stays. None: it is removed."""
        if self.keyframes is None:
            return None
        return self.keyframes.at(min(place, len(self.keyframes.cages) - 1.0))

    @property
    def film(self) -> PoseFile | None:
        """Keys at times, None where the poses follow one another evenly."""
        return None if self.keyframes is None else self.keyframes.film


class Deformation:
    """Edits in the order in which they act, at least one, each with its poses."""

    def __init__(self, parts: Sequence[PosedEdit]):
        self.parts = list(parts)
        self.edits = [part.edit for part in self.parts]
        # The cage at rest and the poses of the edit that has most of them.
        self.pose_count = max((len(part.keyframes.cages) for part in self.parts if part.keyframes), default=1)

    @property
    def posed(self) -> list[Cage | None]:
        """The last pose of each edit, None for one that removes."""
        return self.at(self.pose_count - 1.0)

    def at(self, place: float) -> list[Cage | None]:
        """The cages at a place between the poses: 0 at rest, 1 the first pose, and so on."""
        return [part.at(place) for part in self.parts]

    @property
    def film(self) -> PoseFile | None:
        """The keys at times that last longest, None where no edit has any."""
        films = [part.film for part in self.parts if part.film is not None]
        return max(films, key=lambda film: film.length, default=None)

    @property
    def camera_film(self) -> PoseFile | None:
        """The first keys at times that hold cameras too, None where none do."""
        return next((part.film for part in self.parts if part.film is not None and part.film.cameras), None)

    def at_time(self, seconds: float) -> list[Cage | None]:
        """The cages at a time of the film. Those without keys at times stay at their last pose."""
        return [
            part.at(self.pose_count - 1.0) if part.film is None else part.film.at_time(seconds) for part in self.parts
        ]

    @property
    def is_still(self) -> bool:
        """Whether nothing moves: the scene is the field as it is."""
        return not any(part.edit.remove or _moves(part) for part in self.parts)

    def drawn(self, cages: Sequence[Cage | None]) -> list[Cage]:
        """The cages that an overlay shows: posed ones, and at rest those whose content is removed."""
        return [edit.cage if cage is None else cage for edit, cage in zip(self.edits, cages, strict=True)]

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) vertices of all cages, at rest and posed, world units."""
        cages = [part.edit.cage for part in self.parts]
        cages += [cage for part in self.parts if part.keyframes for cage in part.keyframes.cages]
        return np.concatenate([cage.vertices for cage in cages])

    def fingerprints(self) -> dict[str, list[str]]:
        """Hashes of the edits, "cage", and of their poses, "posed": all that decides how the scene moves."""
        settings = ([e.keep_source, e.remove, e.falloff, e.held, e.fragments] for e in self.edits)
        cages = [_hash([cage_hash(edit.cage), *each]) for edit, each in zip(self.edits, settings, strict=True)]
        return {"cage": cages, "posed": [_pose_hash(part) for part in self.parts]}


@dataclasses.dataclass(frozen=True)
class EditReader:
    """Reads edits by their specs; its attributes hold for all edits that say nothing else."""

    interpolation: str | None = None  # "smooth" or "linear" between several poses of an edit; None takes one pose
    up: str | None = None  # axis that points up in cage files, "y" or "z", and in those of poses; None finds it
    posed_up: str | None = None
    object: str | None = None  # the object of its file that is the cage; None is the only one
    falloff: float = 0.0  # world units, as `CageEdit` has it, and so `fragments`
    fragments: float = 0.0
    timed: bool = False  # poses that have times make a film of their own: see `read_film`
    fps: Fraction | None = None  # rate of numbered cage files in such a film; None is the usual one

    def edits(self, specs: Sequence[EditSpec], field: AnyField | None = None) -> Deformation:
        """Several edits; messages say which is wrong. Without a field axes are those of the formats."""
        if len(specs) > MAX_EDITS:
            raise InputError(f"a scene takes at most {MAX_EDITS} edits, got {len(specs)}")
        parts = []
        for number, edit in enumerate(specs, 1):
            with named(f"edit {number} of {len(specs)}"):
                parts.append(self.edit(edit, [] if edit.posed is None else [edit.posed], field, part=True))
        return Deformation(parts)

    def edit(self, spec: EditSpec, texts: list[str], field: AnyField | None, part: bool = False) -> PosedEdit:
        """An edit with the cages that its spec names. texts: those of its poses; part: whether it is one of several."""
        upward = None if field is None else field.up.tolist()
        rest, expected = read_rest(spec.cage, spec.up or self.up, field, part=part, name=spec.object or self.object)
        texts = [with_up(text, upward) if is_preset(text) else text for text in texts]
        falloff = 0.0 if spec.remove else self.falloff if spec.falloff is None else spec.falloff
        if spec.held != "cut" and not falloff and not spec.remove:
            raise InputError(
                "held names the sides that an edit fades towards: give it a falloff=WIDTH, or leave held out"
            )
        size = self.fragments if spec.fragments is None else spec.fragments
        edit = edit_from_spec(dataclasses.replace(spec, falloff=falloff, fragments=size), rest)
        if spec.remove:
            return PosedEdit(edit, None)
        up = spec.up or self.posed_up or self.up
        keyframes = Keyframes(rest, texts, self.interpolation or "smooth", up, expected, timed=self.timed, fps=self.fps)
        if self.interpolation is None and len(keyframes.cages) > 2:
            keyframes.cages[1:] = [only_pose(rest, texts[0], up, keyframes.cages[1:])]
        return PosedEdit(edit, keyframes)


@contextlib.contextmanager
def named(what: str) -> Iterator[None]:
    """Put a name before what is wrong."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{what}: {error}") from error


def _moves(part: PosedEdit) -> bool:
    """Whether a cage has a pose that is another than the cage at rest."""
    cages = [] if part.keyframes is None else part.keyframes.cages
    return any(
        cage is not part.edit.cage and not np.array_equal(cage.vertices, part.edit.cage.vertices) for cage in cages
    )


def _pose_hash(part: PosedEdit) -> str:
    """A hash of the poses of an edit."""
    keyframes = part.keyframes
    if keyframes is None:
        return ""
    preset = None if keyframes.preset is None else (keyframes.preset.family, keyframes.amounts)
    film = keyframes.film
    moments = None if film is None else (sorted(film.times.items()), sorted(film.easings.items()))
    return _hash([*map(cage_hash, keyframes.cages), preset, moments])


def _hash(parts: Sequence[object]) -> str:
    """sha256 of the texts of some values."""
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()


#: Version 2 has fragments, which version 1 calls crumbs; both are read. A file has the first version that has its keys.
FORMAT, VERSION = "warpcage edits", 2


def read_edits_file(path: PathLike) -> list[EditSpec]:
    """The edits of an edits file in their order; paths, relative to its folder there, as this process opens them."""
    path = require_file(path, "edits file")
    try:
        edits = read_document(path, "edits file", FORMAT, VERSION, format=None, version=None).get("edits")
        if not isinstance(edits, list) or not edits:
            raise InputError("its edits must be a list of at least one edit")
        return [_checked_spec(edit, number, path.parent) for number, edit in enumerate(edits, 1)]
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def write_edits_file(path: PathLike, edits: list[EditSpec]) -> None:
    """Write an edits file, whole or not at all; paths are kept relative to its folder where there is a way."""
    folder = pathlib.Path(path).absolute().parent
    version = 1 if all(edit.fragments is None for edit in edits) else VERSION
    content = {"format": FORMAT, "version": version, "edits": [_json(edit, folder) for edit in edits]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _checked_spec(entry: Any, number: int, folder: pathlib.Path) -> EditSpec:
    """One edit of a file."""
    # what a later version adds has a higher version: an unknown key is a typing error, which must not be lost silently
    edit = EditSpec.from_json(entry, f"edit {number}")
    if not isinstance(edit.cage, str) or not isinstance(edit.posed, str | None):
        raise InputError(f"edit {number}: its cage and its pose must be named in a text, as for --edit")
    return _replaced(edit, lambda path: os.path.join(folder, path))


def _json(edit: EditSpec, folder: pathlib.Path) -> dict[str, Any]:
    """An edit as JSON takes it: what differs from the default, a width of 0 too."""
    widths = {name: getattr(edit, name) for name in ("falloff", "fragments")}
    content = _replaced(edit, lambda path: path_from(folder, path)).to_json()
    content |= {name: value for name, value in widths.items() if value is not None}
    return content | ({"held": edit.held_text} if "held" in content else {})


def _replaced(edit: EditSpec, named: Callable[[str], str]) -> EditSpec:
    """An edit whose files have other names."""
    posed = edit.posed if edit.posed is None or is_preset(edit.posed) else named(edit.posed)
    return dataclasses.replace(edit, cage=named(edit.cage), posed=posed)
