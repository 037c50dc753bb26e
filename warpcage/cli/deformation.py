"""The deformation that a command names: one cage (--cage, --posed), several edits (--edit), or a file of them."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
from collections.abc import Iterator, Sequence

import numpy as np

from ..cage.axes import with_up
from ..cage.cage import Cage
from ..cage.pose_file import PoseFile, cage_hash
from ..cage.presets import is_preset
from ..core.files import require_file
from ..deform.edits import MAX_EDITS, CageEdit
from ..editor.session import FORMAT as SESSION_FORMAT
from ..editor.session import read_session
from ..field.voxel_field import VoxelField
from ..splats.splat_field import SplatField
from .edit_words import EditWords, parse_edit, read_edits_file, read_edits_json
from .keyframes import Keyframes, only_pose
from .standing import posed_up, read_rest


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
        return {"cage": [_edit_hash(edit) for edit in self.edits], "posed": [_pose_hash(part) for part in self.parts]}


def read_deformation(
    args: argparse.Namespace, field: VoxelField | SplatField, interpolation: str | None = None
) -> Deformation | None:
    """The deformation that a command's options name, None where nothing is deformed; the field tells the axes of cage
    files. interpolation: "smooth" or "linear", between several poses of an edit; None takes one pose an edit."""
    ways = [f"--{name}" for name in ("cage", "edit", "edits") if getattr(args, name) is not None]
    if len(ways) > 1:
        raise ValueError(f"{ways[0]} and {ways[1]} do not go together: name each cage of several by --edit")
    if args.posed is not None and args.cage is None:
        raise ValueError("--posed needs --cage, the same cage at rest")
    if args.cage is not None:
        if args.posed is None and not getattr(args, "overlay", False):
            raise ValueError(
                "--cage and --posed go together: the cage at rest and the same cage posed (--overlay shows it at rest)"
            )
        texts = args.posed if isinstance(args.posed, list) else [args.posed or "rest"]
        return Deformation([_read_edit(EditWords(args.cage, texts[0]), texts, args, interpolation, field)])
    if args.edits is not None and is_session(args.edits):
        return session_edits(args.edits, interpolation)[0]
    words = [parse_edit(text) for text in args.edit or ()]
    if args.edits is not None:
        words = read_edits_file(args.edits)
    return numbered_edits(words, args, interpolation, field) if words else None


def numbered_edits(
    words: Sequence[EditWords],
    args: argparse.Namespace,
    interpolation: str | None,
    field: VoxelField | SplatField | None = None,
) -> Deformation:
    """The deformation of several edits; messages say which is wrong. Without a field axes are those of the formats."""
    if len(words) > MAX_EDITS:
        raise ValueError(f"a scene takes at most {MAX_EDITS} edits, got {len(words)}")
    parts = []
    for number, edit in enumerate(words, 1):
        with _named(f"edit {number} of {len(words)}"):
            texts = [] if edit.posed is None else [edit.posed]
            parts.append(_read_edit(edit, texts, args, interpolation, field, part=True))
    return Deformation(parts)


def is_deformed(args: argparse.Namespace) -> bool:
    """Whether options name a deformation."""
    return any(getattr(args, name, None) is not None for name in ("cage", "edit", "edits"))


def is_session(path: str) -> bool:
    """Whether a file of --edits is a session of the editor. Raises for a file that is not there or no JSON."""
    file = require_file(path, "edits file")
    try:
        return read_edits_json(file).get("format") == SESSION_FORMAT
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def _own_or_all(own: float | None, args: argparse.Namespace, name: str) -> float:
    """What an edit says for itself, or else what an option says for all edits."""
    return (getattr(args, name, None) or 0.0) if own is None else own


def _read_edit(
    words: EditWords,
    texts: list[str],
    args: argparse.Namespace,
    interpolation: str | None,
    field: VoxelField | SplatField | None,
    part: bool = False,
) -> PosedEdit:
    """An edit with the cages that its words name. texts: words of --posed; part: whether it is one of several."""
    rest, expected = read_rest(words.cage, words.up or args.cage_up, field, part=part)
    texts = [with_up(text, None if field is None else field.up.tolist()) if is_preset(text) else text for text in texts]
    falloff = 0.0 if words.remove else _own_or_all(words.falloff, args, "falloff")
    if words.held != "cut" and not falloff and not words.remove:
        raise ValueError("held names the walls that an edit fades towards: give it a falloff=WIDTH, or leave held out")
    crumbs = _own_or_all(words.crumbs, args, "crumbs")
    edit = CageEdit(rest, keep_source=words.keep, remove=words.remove, falloff=falloff, held=words.walls, crumbs=crumbs)
    if words.remove:
        return PosedEdit(edit, None)
    up, timed = words.up or posed_up(args), getattr(args, "timed", False)
    keyframes = Keyframes(
        rest, texts, interpolation or "smooth", up, expected, timed=timed, fps=getattr(args, "film_rate", None)
    )
    if interpolation is None and len(keyframes.cages) > 2:
        keyframes.cages[1:] = [only_pose(rest, texts[0], up, keyframes.cages[1:])]
    return PosedEdit(edit, keyframes)


def session_edits(path: str, interpolation: str | None = None) -> tuple[Deformation, list[str]]:
    """The visible edits of a session of the editor, in the poses that it was left in, and a line on each edit."""
    visible = [edit for edit in read_session(path).edits if edit.visible]
    if not visible:
        raise ValueError(f"{path}: the session has no visible edit")
    parts = []
    for edit in visible:
        with _named(f"{path}: edit {edit.name!r}"):
            cage_edit, keyframes = edit.cage_edit, None
            if not cage_edit.remove:
                keyframes = Keyframes(cage_edit.cage, [], interpolation or "smooth")
                posed = cage_edit.cage.with_vertices(edit.posed)
                posed.require_usable("the posed cage")
                keyframes.cages.append(posed)
            parts.append(PosedEdit(cage_edit, keyframes))
    return Deformation(parts), [f"{edit.name}: {edit.kind}" for edit in visible]


@contextlib.contextmanager
def _named(what: str) -> Iterator[None]:
    """Put a name before what is wrong."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error


def _moves(part: PosedEdit) -> bool:
    """Whether a cage has a pose that is another than the cage at rest."""
    cages = [] if part.keyframes is None else part.keyframes.cages
    return any(
        cage is not part.edit.cage and not np.array_equal(cage.vertices, part.edit.cage.vertices) for cage in cages
    )


def _edit_hash(edit: CageEdit) -> str:
    """A hash of an edit at rest."""
    return _hash([cage_hash(edit.cage), edit.keep_source, edit.remove, edit.falloff, edit.held, edit.crumbs])


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
