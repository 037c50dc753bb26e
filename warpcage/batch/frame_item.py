"""Items that are pictures of a field, as it is or deformed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from ..core.checks import shown
from ..core.names import COORDINATES, DENSITIES, SPLAT_MAPS
from . import words
from .edit_words import EDIT_WORDS, EditWords
from .item import ID, Item, digest, output_path
from .words import TRANSPARENT, Checker, checked_words, one_of, safe_name, text

#: Endings of the files that each part of a frame may be written to.
PART_ENDINGS = {
    "rgb": (".png", ".jpg", ".jpeg", ".exr", ".npy"),
    "alpha": (".png", ".npy"),
    "depth": (".npy", ".exr", ".png"),
    "disparity": (".png", ".npy"),
    "masks": (".png",),
    "reveal": (".png", ".npy"),
    "fold": (".png", ".npy"),
    "outside": (".npy",),
    "film": (".npz",),
    "pose": (".npy",),
    "record": (".json",),
}


def _edits(value: Any, word: str) -> tuple[EditWords, ...]:
    if not isinstance(value, list) or not value:
        raise ValueError(f"{word} must be a list of at least one edit, got {shown(value)}")
    return tuple(EditWords.from_json(entry, f"edit {number} of {word}") for number, entry in enumerate(value, 1))


def _resolution(value: Any, word: str) -> int | str:
    if value == "precise":
        return value
    if type(value) is not int or value < 1:
        raise ValueError(
            f'{word} must be a whole number of lattice cells, or "precise" (mean_value and green only), '
            f"got {shown(value)}"
        )
    return value


def _camera(value: Any, word: str) -> Any:
    if isinstance(value, str) and value:
        return text(value, word)
    if not isinstance(value, dict) or not value:
        raise ValueError(
            f"{word} must be an object with {', '.join(_PINHOLE)}, or one with eye, target, width and height; or "
            f'"cameras.json#NAME" or "transforms.json#3", got {shown(value)}'
        )
    if "eye" in value or "target" in value and "camera_to_world" not in value:
        checked_words(value, _LOOKING, word)
    needed = {name: each for name, each in _LOOKING.items() if name not in _USUAL} if "eye" in value else _PINHOLE
    for name, check in needed.items():
        if value.get(name) is None:
            raise ValueError(f"{word} lacks {name!r}")
        check(value[name], f"{name!r} of {word}")
    return value


def _vector(value: Any, word: str) -> tuple[float, ...]:
    return words.numbers(value, word, 3)


def _pose(value: Any, word: str) -> Any:
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError(f"{word} must be four rows of four numbers, got {shown(value)}")
    return [words.numbers(row, f"a row of {word}", 4) for row in value]


_SIDE = words.whole(1, 65_536)

#: A camera as files of cameras have it, and one that looks from a place to another, of which two words may be left out.
_PINHOLE: dict[str, Checker] = {
    **dict.fromkeys(("fx", "fy"), words.positive),
    **dict.fromkeys(("cx", "cy"), words.number),
    **dict.fromkeys(("width", "height"), _SIDE),
    "camera_to_world": _pose,
}
_LOOKING: dict[str, Checker] = {
    **dict.fromkeys(("eye", "target", "up"), _vector),
    "fov_degrees": words.positive,
    **dict.fromkeys(("width", "height"), _SIDE),
}
_USUAL = ("up", "fov_degrees")


def _size(value: Any, word: str) -> tuple[int, ...]:
    sides = value if isinstance(value, list | tuple) else [value]
    if not 1 <= len(sides) <= 2:
        raise ValueError(f"{word} must be a width, or [width, height], in pixels, got {shown(value)}")
    return tuple(_SIDE(side, word) for side in sides)


def _scale(value: Any, word: str) -> tuple[float, float]:
    low, high = words.numbers(value, word, 2)
    if high < low:
        raise ValueError(f"{word} must be [low, high], got [{low:g}, {high:g}]")
    return low, high


def _frame_outputs(value: Any, word: str) -> dict[str, str]:
    if not isinstance(value, dict) or not value:
        raise ValueError(f'{word} must be an object such as {{"rgb": "{ID}.png", "depth": "{ID}.npy"}}')
    for part, path in value.items():
        if part not in PART_ENDINGS:
            raise ValueError(f"{word} has no {shown(part)}, only {', '.join(PART_ENDINGS)}")
        endings = PART_ENDINGS[part]
        if not isinstance(path, str) or not path.lower().endswith(endings):
            raise ValueError(f"{part!r} of {word} must end in {' '.join(endings)}, got {shown(path)}")
    return dict(value)


#: Words of the short form of one edit.
SHORT_EDIT = tuple(EDIT_WORDS)


@dataclasses.dataclass(frozen=True, eq=False)
class FrameItem(Item):
    """A picture of a field, as it is or deformed."""

    # Outputs by part: rgb, alpha, depth, disparity, masks, reveal, fold, outside; film, the colours as films of 16 bits
    # take them; pose, the vertices of its posed cages; record, what `batch.records.frame_record` says of it.

    # a file, voxels or splats
    field: str = ""
    # an object, or a reference
    camera: Any = None
    # in the order in which they act; none shows the field as it is
    edits: tuple[EditWords, ...] = ()
    # width, or width and height, at which the camera is taken; its own where it is empty
    size: tuple[int, ...] = ()
    coordinates: str = "harmonic"
    # cells of the lattice, "precise", or None: by the size of the picture
    resolution: int | str | None = None
    density: str = "opacity"
    map: str | None = None
    # a colour, "transparent", or None: the field's own
    background: Any = None
    # whether what was uncovered is filled
    fill: bool = False
    # whether the cages are drawn into the picture
    overlay: bool = False
    # rays along each side of a pixel; None is the field's
    supersampling: int | None = None
    # of splats only: whether those that are smaller than a pixel are weakened; see `SplatField.render`
    antialias: bool = False
    # low and high disparity of pictures of depth and disparity; None is the range of the frame
    disparity_scale: tuple[float, float] | None = None
    # as `VoxelField.load` has it
    scene_scale: float = 1.0

    kind: ClassVar[str] = "frame"
    known: ClassVar[dict[str, Checker]] = {
        "id": safe_name,
        "kind": words.anything,
        "field": text,
        "camera": _camera,
        "size": _size,
        "edits": _edits,
        **EDIT_WORDS,
        "coordinates": one_of(*COORDINATES),
        "resolution": _resolution,
        "density": one_of(*DENSITIES),
        "map": one_of(*SPLAT_MAPS),
        "background": words.background,
        "fill": words.truth,
        "overlay": words.truth,
        "supersampling": words.whole(1, 8),
        "antialias": words.truth,
        "disparity_scale": _scale,
        "scene_scale": words.positive,
        "outputs": _frame_outputs,
        "extra": words.anything,
    }

    @property
    def group(self) -> str:
        loaded = [self.field, self.scene_scale, *([edit.rest for edit in self.edits] or [None])]
        how = [self.coordinates, self.resolution, self.density, self.map] if self.edits else []
        return f"frame {self.field} {digest(loaded + how)}"

    @property
    def pose(self) -> str:
        return digest([edit.posed for edit in self.edits]) if self.edits else ""

    @property
    def version(self) -> int:
        return 2 if any(edit.is_drawn for edit in self.edits) else 1

    @classmethod
    def _made(cls, entry: Mapping[str, Any], usual: dict[str, Any]) -> Item:
        if entry.get("edits") is not None:  # which stands in place of the one edit that defaults may have
            usual = {word: value for word, value in usual.items() if word not in SHORT_EDIT}
        elif entry.get("cage") is not None:
            usual = {word: value for word, value in usual.items() if word != "edits"}
        return super()._made(entry, usual)

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        for word in ("field", "camera"):
            if word not in given:
                raise ValueError(f"a frame needs a {word!r}")
        short = {word: given.pop(word) for word in SHORT_EDIT if word in given}
        if short and "edits" in given:
            raise ValueError(f"{next(iter(short))!r} and 'edits' do not go together: put it into one of the edits")
        if short:
            if "cage" not in short:
                raise ValueError(f"{next(iter(short))!r} needs a 'cage', the cage at rest")
            given["edits"] = (EditWords(**short),)
        outputs = given.get("outputs") or {"rgb": f"{ID}.png"}
        given["outputs"] = {
            part: output_path(path, given["id"], f"{part!r} of 'outputs'") for part, path in outputs.items()
        }
        _require_possible(given)
        return given


def _require_possible(given: dict[str, Any]) -> None:
    """Raise ValueError for words of a frame that do not go together."""
    outputs, edits = given["outputs"], given.get("edits")
    if len(set(outputs.values())) < len(outputs):
        raise ValueError(f"two of the 'outputs' are one file: {', '.join(outputs.values())}")
    needing = [part for part in ("masks", "reveal", "fold", "outside") if part in outputs]
    needing += [word for word in ("fill", "overlay") if given.get(word)]
    if needing and not edits:
        raise ValueError(f"{needing[0]!r} needs a deformation: 'cage' and 'posed', or 'edits'")
    if given.get("resolution") == "precise" and given.get("coordinates", "harmonic") == "harmonic":
        raise ValueError("harmonic coordinates have no closed form: give 'resolution' a number, or leave it out")
    clear = given.get("background") == TRANSPARENT
    if clear and outputs.get("rgb", "").lower().endswith((".jpg", ".jpeg")):
        raise ValueError("a JPEG has no opacity: write a .png or .exr, or name another 'background'")
    if given.get("fill") and given.get("background") is not None:
        raise ValueError("'fill' continues the field's own background: it cannot be combined with 'background'")
