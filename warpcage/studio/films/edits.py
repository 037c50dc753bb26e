"""Edits of a scene with the poses that their cages go through: read from arguments and from edits files."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from ...cage.axes import with_up
from ...cage.cage import Cage
from ...cage.pose_file import PoseFile, cage_hash
from ...cage.presets import Preset, is_preset
from ...core.files import PathLike, atomic_path, errors_of, path_from, read_document, require_file
from ...core.names import named_errors
from ...core.spec import options_json
from ...edits.edits import MAX_EDITS, CageEdit, edit_from_spec
from ...edits.spec import EditSpec
from ...errors import InputError
from ...splats.splat_field import AnyField
from ...view.motion import value_along
from .motion import pose_along
from .resolve import AssetResolver


class PosedEdit:
    """One edit, and the poses that its cage goes through; an edit that removes has none."""

    def __init__(
        self,
        edit: CageEdit,
        poses: Sequence[Cage] = (),
        interpolation: str = "smooth",  # or "linear"
        presets: Sequence[Preset] = (),  # of all poses, where all are presets
        film: PoseFile | None = None,  # of poses with times of their own; None: they follow one another evenly
    ):
        self.edit, self.poses, self.interpolation, self.film = edit, list(poses), interpolation, film
        self.preset: Preset | None = None  # whose amount is interpolated
        self.amounts: list[tuple[float, ...]] = []  # at rest, and of each pose
        moving = [preset for preset in presets if preset.kind != "rest"]
        if len({preset.family for preset in moving}) == 1:
            self.preset = moving[0]
            still = (self.preset.neutral,) * len(self.preset.amount)
            self.amounts = [still] + [still if preset.kind == "rest" else preset.amount for preset in presets]

    @property
    def cages(self) -> list[Cage]:
        """The cage at rest and its poses; none of an edit that removes."""
        return [] if self.edit.remove else [self.edit.cage, *self.poses]

    def at(self, place: float) -> Cage | None:
        """The cage at a place, 0 at rest and 1 the first pose; after its last pose it stays. None: it is removed."""
        # Each vertex by itself; of one preset with different amounts the amount, so that a bend stays an arc.
        if self.edit.remove:
            return None
        place = min(place, float(len(self.poses)))
        if self.preset is None:
            return pose_along(self.cages, place, self.interpolation)
        amount = value_along([np.array(amount) for amount in self.amounts], place, self.interpolation)
        return self.preset.at(self.edit.cage, amount.tolist())

    @property
    def moves(self) -> bool:
        """Whether a pose is another than the cage at rest."""
        rest = self.edit.cage
        return any(pose is not rest and not np.array_equal(pose.vertices, rest.vertices) for pose in self.poses)

    def pose_hash(self) -> str:
        """A hash of the poses."""
        if self.edit.remove:
            return ""
        preset = None if self.preset is None else (self.preset.family, self.amounts)
        film = self.film
        moments = None if film is None else (sorted(film.times.items()), sorted(film.easings.items()))
        return _hash([*map(cage_hash, self.cages), preset, moments])


class Deformation:
    """Edits in the order in which they act, each with its poses; none where a field is shown as it is."""

    def __init__(self, parts: Sequence[PosedEdit] = ()):
        self.parts = list(parts)
        self.edits = [part.edit for part in self.parts]
        self.pose_count = 1 + max(
            (len(part.poses) for part in self.parts), default=0
        )  # of the edit that has most, and at rest

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
        return not any(part.edit.remove or part.moves for part in self.parts)

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) vertices of all cages, at rest and posed, world units."""
        cages = [*(edit.cage for edit in self.edits), *(cage for part in self.parts for cage in part.cages)]
        return np.concatenate([cage.vertices for cage in cages])

    def fingerprints(self) -> dict[str, list[str]]:
        """Hashes of the edits, "cage", and of their poses, "posed": all that decides how the scene moves."""
        settings = ([e.keep_source, e.remove, e.falloff, e.held, e.fragments] for e in self.edits)
        cages = [_hash([cage_hash(edit.cage), *each]) for edit, each in zip(self.edits, settings, strict=True)]
        return {"cage": cages, "posed": [part.pose_hash() for part in self.parts]}


@dataclasses.dataclass(frozen=True)
class EditReader:
    """Reads edits by their specs."""

    resolver: AssetResolver = dataclasses.field(default_factory=AssetResolver)
    interpolation: str | None = None  # "smooth" or "linear" between several poses of an edit; None takes one pose
    defaults: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of options that are None in a spec, by name
    posed_up: str | None = None  # axis that points up in files of poses; None is that of cages at rest
    timed: bool = False  # poses that have times make a film of their own: see `AssetResolver.film`
    fps: Fraction | None = None  # rate of numbered cage files in such a film; None is the default

    def completed(self, spec: EditSpec) -> EditSpec:
        """A spec with the defaults where it has no values; what it removes has no falloff."""
        missing = {name: value for name, value in self.defaults.items() if getattr(spec, name) is None}
        if spec.remove:
            missing.pop("falloff", None)
        return dataclasses.replace(spec, **missing)

    def edits(self, specs: Sequence[EditSpec], field: AnyField | None = None) -> Deformation:
        """Several edits; messages say which is wrong. Without a field axes are those of the formats."""
        if len(specs) > MAX_EDITS:
            raise InputError(f"a scene takes at most {MAX_EDITS} edits, got {len(specs)}")
        parts = []
        for number, edit in enumerate(specs, 1):
            with named_errors(f"edit {number} of {len(specs)}"):
                parts.append(self.edit(edit, [] if edit.posed is None else [edit.posed], field, part=True))
        return Deformation(parts)

    def edit(self, spec: EditSpec, texts: list[str], field: AnyField | None, part: bool = False) -> PosedEdit:
        """An edit with the cages that its spec names. texts: those of its poses; part: whether it is one of several."""
        resolver, up = self.resolver, spec.up or self.posed_up
        spec = self.completed(spec)
        rest = resolver.rest(spec.cage, spec.up, field, object=spec.object, part=part)
        if spec.held != "cut" and not spec.falloff:
            raise InputError(
                "held names the sides that an edit fades towards: give it a falloff=WIDTH, or leave held out"
            )
        edit, up = edit_from_spec(spec, rest.cage), up or spec.up
        if spec.remove:
            return PosedEdit(edit)
        film = resolver.film(rest, texts, up, self.fps) if self.timed else None
        if film is not None:
            poses = [(f"keyframe {name!r} of {texts[0]!r}", film[name]) for name in film.timed]
        elif self.interpolation is not None:
            likely = resolver.with_ups(rest, texts) if up is None else rest
            poses = [(f"cage {text!r}", pose) for text in texts for pose in resolver.poses(likely, text, up)]
        elif len(texts) == 1:
            poses = [(f"cage {texts[0]!r}", resolver.pose(rest, texts[0], up))]
        else:
            raise InputError(f"one pose is needed, got {len(texts)}: {' '.join(texts)}")
        for name, pose in poses:
            pose.require_usable(name)
        all_presets = film is None and all(map(is_preset, texts))
        presets = [Preset(with_up(text, rest.field_up)) for text in texts] if all_presets else []
        return PosedEdit(edit, [pose for _, pose in poses], self.interpolation or "smooth", presets, film)


def _hash(parts: Sequence[object]) -> str:
    """sha256 of the texts of some values."""
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()


#: Version 2 has fragments, which version 1 calls crumbs; both are read. A file has the first version that has its keys.
FORMAT, VERSION = "warpcage edits", 2


def read_edits_file(path: PathLike) -> list[EditSpec]:
    """The edits of an edits file in their order; paths, relative to its folder there, as this process opens them."""
    path = require_file(path, "edits file")
    with errors_of(path, "edits file"):
        edits = read_document(path, "edits file", FORMAT, VERSION, format=None, version=None).get("edits")
        if not isinstance(edits, list) or not edits:
            raise InputError("its edits must be a list of at least one edit")
        specs = []
        for number, entry in enumerate(edits, 1):
            # what a later version adds has a higher version: an unknown key is a typing error
            spec = EditSpec.from_json(entry, f"edit {number}")
            if not isinstance(spec.cage, str) or not isinstance(spec.posed, str | None):
                raise InputError(f"edit {number}: its cage and its pose must be named in a text, as for --edit")
            specs.append(_replaced(spec, functools.partial(os.path.join, path.parent)))
        return specs


def write_edits_file(path: PathLike, edits: list[EditSpec]) -> None:
    """Write an edits file, whole or not at all; paths are kept relative to its folder where there is a way."""
    folder = pathlib.Path(path).absolute().parent
    version = 1 if all(edit.fragments is None for edit in edits) else VERSION
    content = {"format": FORMAT, "version": version, "edits": [_json(edit, folder) for edit in edits]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _json(edit: EditSpec, folder: pathlib.Path) -> dict[str, Any]:
    """An edit as JSON takes it: what differs from the default, a width of 0 too."""
    content = options_json(_replaced(edit, functools.partial(path_from, folder)))
    return content | ({"held": edit.held_text} if "held" in content else {})


def _replaced(edit: EditSpec, named: Callable[[str], str]) -> EditSpec:
    """An edit whose files have other names."""
    posed = edit.posed if edit.posed is None or is_preset(edit.posed) else named(edit.posed)
    return dataclasses.replace(edit, cage=named(edit.cage), posed=posed)
