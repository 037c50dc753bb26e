"""What stands beside a command's field in one scene."""

from __future__ import annotations

import argparse
import hashlib
import pathlib
from typing import Any

import numpy as np

from ...cage.pose_file import PoseFile
from ...core.files import require_file
from ...deform.deformer import Deformer
from ...deform.stage import Stage
from ...edits.place import Place, PlaceFile
from ...edits.stage_file import free_name
from ...errors import InputError
from ...splats.io import splat_path
from ...splats.splat_field import load_field
from .. import shared
from ..words import parse_add


class Staging:
    """What stands beside a command's field, in one scene: of --add, or of a stage file; with what moves in films."""

    def __init__(
        self, args: argparse.Namespace, field: shared.AnyField, stage: Stage | None, interpolation: str | None = None
    ):
        self.stage = Stage(device=field.device) if stage is None else stage
        self.of_file = stage is not None
        if stage is None:
            self.stage.add(pathlib.Path(args.field).stem, field, path=args.field)
        self.main = next(iter(self.stage.items))
        self.moving: list[tuple[Deformer, shared.Deformation]] = []
        for text in args.add or ():
            path, place, edits = parse_add(text)
            name = free_name(pathlib.Path(path).stem, self.stage.items)
            path = require_file(splat_path(path), "field file")
            thing: Any = load_field(path, device=field.device)
            if edits is not None:
                deformation = shared.edits_of_file(edits, args, interpolation, thing)
                thing = shared.make_deformer(thing, deformation, args).pose(deformation.posed)
                self.moving.append((thing, deformation))
            self.stage.add(name, thing, place=place, path=path)

    def points(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) points around what a picture shows, world units; points: those around the command's own field."""
        seen = [] if self.of_file else [points]
        times = {0.0, *(time for item in self.stage.items.values() for time in item.places.places)}
        for self.stage.time in sorted(times, reverse=True):  # last the first, where pictures are made
            seen.append(self.stage.shown_points)
        return np.concatenate(seen)

    def with_main(self, renderer: shared.AnyField | Deformer) -> Stage:
        """The stage with what renders the command's own field; the things of a stage file stay as they are."""
        if not self.of_file and self.stage[self.main] is not renderer:
            self.stage.replace(self.main, renderer)
        return self.stage

    def at(self, seconds: float) -> None:
        """Move all to a time of the film, but for the command's own field, which its own poses move."""
        self.stage.time = seconds
        for deformer, deformation in self.moving:
            deformer.pose(deformation.at_time(seconds))

    def longest(self, film: PoseFile | None) -> PoseFile | PlaceFile | None:
        """The keys at times, of poses and of places, that last longest; None where there are none."""
        films: list[PoseFile | PlaceFile] = [] if film is None else [film]
        films += [each.film for _, each in self.moving if each.film is not None]
        films += [item.places for item in self.stage.items.values() if item.places.length > 0.0]
        return max(films, key=lambda each: each.length, default=None)

    def fingerprints(self) -> list[Any]:
        """All that decides how the scene looks besides the command's own field and its poses."""
        items = self.stage.items.items()
        paths = [item.path for _, item in items if item.path is not None and item.path.is_file()]
        files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
        places = [[name, item.places.to_json()] for name, item in items]
        return [places, files, [deformation.fingerprints() for _, deformation in self.moving]]


def read_things(args: argparse.Namespace) -> tuple[shared.AnyField, Stage | None]:
    """The field of a command that may show several things, and the stage where its file is one of a stage."""
    if args.fill and (args.add or shared.is_stage(args.field)):
        raise InputError("--fill is for a field alone: leave it out where several things are shown")
    if not shared.is_stage(args.field):
        return shared.read_field(args), None
    if shared.is_deformed(args):
        raise InputError("the things of a stage file have cages of their own: leave --cage, --edit and --edits out")
    shared.require_field_scale(args)
    stage = Stage.load(args.field, device=shared.chosen_device(args))
    first = next(iter(stage.items.values()))
    args.up = tuple(stage.up) if args.up is None else args.up
    args.straightening = first.field.straightening if first.places.at(0.0) == Place() else None
    return first.field, stage


def staging_of(
    args: argparse.Namespace, field: shared.AnyField, stage: Stage | None, interpolation: str | None = None
) -> Staging | None:
    """What stands beside the field of a command, None where it is alone."""
    several = stage is not None or args.add or getattr(args, "save_stage", None)
    return Staging(args, field, stage, interpolation) if several else None
