"""Items of a job: a frame, a fit or an evaluation, as a line of a job file describes it."""

from __future__ import annotations

import abc
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any, ClassVar

from ..core.checks import shown
from ..core.names import BACKGROUNDS, COORDINATES, DENSITIES, SPLAT_MAPS
from . import words
from .words import Checker, checked_words, one_of, safe_name, text

#: What stands behind a picture with opacity.
TRANSPARENT = "transparent"

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
    "pose": (".npy",),
    "record": (".json",),
}

#: Names in the folder of a run that no output may have, in any case of letters.
RESERVED = ("manifest.jsonl",)

#: What stands for an item's id in the names of its outputs.
ID = "{id}"


@dataclasses.dataclass(frozen=True, eq=False)
class Item(abc.ABC):
    """One thing to make.

    Args:
        id: Its name, unique in its job: a relative name.
        outputs: The files that it writes by what they hold, relative to the folder of the run.
        extra: Any JSON that is kept with its record.
    """

    id: str
    outputs: dict[str, str]
    extra: Any = None

    kind: ClassVar[str]
    known: ClassVar[dict[str, Checker]]

    @property
    @abc.abstractmethod
    def group(self) -> str:
        """What a worker has to load for it: items of one group share that."""

    @property
    def pose(self) -> str:
        """What it shows of what is loaded: items of one group and pose share a map. Empty where there is none."""
        return ""

    @property
    def order(self) -> tuple[str, str]:
        """By which items are sorted so that workers load and pose as little as they can."""
        return self.group, self.pose

    def to_json(self) -> dict[str, Any]:
        """The item as JSON, with all that it takes from defaults of its file; what differs from the usual alone.

        Returns:
            An object of which `Item.from_json` makes an equal item.
        """
        entry: dict[str, Any] = {"id": self.id, "kind": self.kind, "outputs": dict(self.outputs)}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name not in entry and value != _default(field):
                entry[field.name] = _plain(value)
        return entry

    @staticmethod
    def from_json(entry: Mapping[str, Any], defaults: Mapping[str, Any] | None = None) -> Item:
        """An item from JSON.

        Args:
            entry: The object.
            defaults: What holds where the object says nothing; words of other kinds of items are left out. None is
                nothing.

        Returns:
            A FrameItem, FitItem or EvaluateItem.

        Raises:
            ValueError: What is wrong in which word, and what would be right.
        """
        if not isinstance(entry, Mapping):
            raise ValueError(f"an item must be a JSON object, got {shown(entry)}")
        kind = entry.get("kind") or (defaults or {}).get("kind") or "frame"
        if not isinstance(kind, str) or kind not in KINDS:
            raise ValueError(f"'kind' must be one of {', '.join(KINDS)}, got {shown(kind)}")
        maker = KINDS[kind]
        usual = {word: value for word, value in (defaults or {}).items() if word in maker.known}
        return maker._made(dict(entry), usual)

    @classmethod
    def _made(cls, entry: dict[str, Any], usual: dict[str, Any]) -> Item:
        given = checked_words({**usual, **entry}, cls.known, f"an item of kind {cls.kind!r}")
        given.pop("kind", None)
        if "id" not in given:
            raise ValueError('an item needs an "id", such as "frame_0001"')
        return cls(**cls._completed(given))

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        """The arguments of the constructor of checked words."""
        raise NotImplementedError


def _default(field: dataclasses.Field) -> Any:
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else field.default


def _plain(value: Any) -> Any:
    """A value as JSON takes it."""
    if isinstance(value, EditWords):
        return value.to_json()
    return [_plain(each) for each in value] if isinstance(value, tuple) else value


def canonical(value: Any) -> str:
    """The one text of a JSON value.

    Args:
        value: Any JSON.

    Returns:
        JSON with sorted words and no spaces.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def digest(value: Any) -> str:
    """A short hash of a JSON value.

    Args:
        value: Any JSON.

    Returns:
        16 hexadecimal digits.
    """
    return hashlib.blake2b(canonical(value).encode(), digest_size=8).hexdigest()


# -- words of edits


def _cage(value: Any, word: str) -> Any:
    if isinstance(value, dict):
        if set(value) != {"vertices", "faces"}:
            raise ValueError(f'{word} must be a cage file, or "vertices" and "faces", got {shown(value)}')
        return {name: _array(each, f"{name!r} of {word}") for name, each in value.items()}
    return text(value, word)


def _array(value: Any, word: str) -> Any:
    if isinstance(value, list) and value:
        return value
    if isinstance(value, str) and value:
        return text(value, word)
    raise ValueError(f'{word} must be an array: "file.npy", "file.npy#17" or a list of [x, y, z], got {shown(value)}')


def _held(value: Any, word: str) -> Any:
    if value in ("cut", "still"):
        return value
    if isinstance(value, str):
        try:
            value = [int(part) for part in value.split(",")]
        except ValueError:
            value = None
    if isinstance(value, list | tuple) and value and all(type(each) is int and each >= 0 for each in value):
        return tuple(value)
    raise ValueError(f'{word} must be "cut", "still", or numbers of faces such as [4, 5, 17], got {shown(value)}')


EDIT_WORDS: dict[str, Checker] = {
    "cage": _cage,
    "posed": _array,
    "keep": words.truth,
    "remove": words.truth,
    "falloff": words.not_negative,
    "held": _held,
    "crumbs": words.not_negative,
    "up": one_of("y", "z"),
}


@dataclasses.dataclass(frozen=True)
class EditWords:
    """One edit of a frame, with the words of `warpcage.CageEdit`.

    Args:
        cage: The cage at rest: a file, or "vertices" and "faces".
        posed: The same cage posed: a file, a keyframe ("poses.json#wave") or an array. None for an edit that removes.
        keep: Leave a copy where it was.
        remove: Draw nothing in its place.
        falloff: Width of the band in which the edit fades to rest, world units.
        held: The walls that it fades towards: "cut", "still", or numbers of faces.
        crumbs: Size of the crumbs that go with the part, world units.
        up: Axis that points up in its cage files. None finds it.
    """

    cage: Any
    posed: Any = None
    keep: bool = False
    remove: bool = False
    falloff: float = 0.0
    held: str | tuple[int, ...] = "cut"
    crumbs: float = 0.0
    up: str | None = None

    def __post_init__(self) -> None:
        if self.keep and self.remove:
            raise ValueError("'keep' and 'remove' do not go together: choose one")
        if self.remove and self.posed is not None:
            raise ValueError("what is removed needs no 'posed'")
        if self.remove and (self.falloff or self.held != "cut"):
            raise ValueError("what is removed has no band in which it fades to rest: leave 'falloff' and 'held' out")
        if not self.remove and self.posed is None:
            raise ValueError("'cage' needs 'posed', the same cage posed, or \"remove\": true")
        if self.held != "cut" and not self.falloff:
            raise ValueError("'held' names the walls that an edit fades towards: give it a 'falloff' too")

    @classmethod
    def from_json(cls, entry: Any, what: str) -> EditWords:
        """An edit from JSON; what: how messages call it. Raises ValueError for words that cannot be."""
        if not isinstance(entry, Mapping):
            raise ValueError(f"{what} must be an object with a cage, got {shown(entry)}")
        given = checked_words(entry, EDIT_WORDS, what)
        if "cage" not in given:
            raise ValueError(f"{what} needs a 'cage'")
        return cls(**given)

    def to_json(self) -> dict[str, Any]:
        """The edit as JSON: what differs from the default."""
        fields = ((field.name, getattr(self, field.name), field.default) for field in dataclasses.fields(self))
        return {name: _plain(value) for name, value, default in fields if value != default}

    @property
    def rest(self) -> dict[str, Any]:
        """The edit without its pose."""
        return {name: value for name, value in self.to_json().items() if name != "posed"}


# -- words of frames


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
    if isinstance(value, dict) and value:
        return value
    if isinstance(value, str) and value:
        return text(value, word)
    raise ValueError(
        f"{word} must be an object with fx, fy, cx, cy, width, height and camera_to_world, one with eye, target, width "
        f'and height, "cameras.json#NAME" or "transforms.json#3", got {shown(value)}'
    )


def _size(value: Any, word: str) -> tuple[int, ...]:
    sides = value if isinstance(value, list | tuple) else [value]
    if not 1 <= len(sides) <= 2 or not all(type(side) is int and 1 <= side <= 65_536 for side in sides):
        raise ValueError(f"{word} must be a width, or [width, height], in pixels, got {shown(value)}")
    return tuple(sides)


def _background(value: Any, word: str) -> Any:
    if isinstance(value, str) and value in (*BACKGROUNDS, TRANSPARENT):
        return value
    if isinstance(value, list | tuple):
        colour = words.numbers(value, word, 3)
        if min(colour) >= 0.0 and max(colour) <= 1.0:
            return colour
    known = ", ".join((*BACKGROUNDS, TRANSPARENT))
    raise ValueError(f"{word} must be one of {known}, or three numbers in [0, 1], got {shown(value)}")


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


def output_path(path: Any, item_id: str, word: str) -> str:
    """A checked name of an output, with the item's id put in. Raises ValueError for others."""
    found = safe_name(path.replace(ID, item_id) if isinstance(path, str) else path, word)
    if found.lower() in RESERVED:
        raise ValueError(f"{word} cannot be {found!r}, which is the run's own")
    return found


#: Words of the short form of one edit.
SHORT_EDIT = tuple(EDIT_WORDS)


@dataclasses.dataclass(frozen=True, eq=False)
class FrameItem(Item):
    """A picture of a field, as it is or deformed.

    Args:
        id: As for `Item`.
        outputs: Files by part: rgb, alpha, depth, disparity, masks, reveal, fold, outside; pose, the vertices of
            its posed cages; record, what `batch.records.frame_record` says of it.
        extra: As for `Item`.
        field: The field file, voxels or splats.
        camera: The camera: an object, or a reference.
        edits: The edits in the order in which they act; none shows the field as it is.
        size: Width, or width and height, at which the camera is taken; its own where it is empty.
        coordinates: As `Deformer` has it.
        resolution: Cells of the lattice, "precise", or None: by the size of the picture.
        density: As `Deformer` has it.
        map: As `Deformer` has it.
        background: A colour, "transparent", or None: the field's own.
        fill: Whether what was uncovered is filled.
        overlay: Whether the cages are drawn into the picture.
        supersampling: Rays along each side of a pixel. None is the field's.
        disparity_scale: Low and high disparity of pictures of depth and disparity. None is the range of the frame.
        scene_scale: As `VoxelField.load` has it.
    """

    field: str = ""
    camera: Any = None
    edits: tuple[EditWords, ...] = ()
    size: tuple[int, ...] = ()
    coordinates: str = "harmonic"
    resolution: int | str | None = None
    density: str = "opacity"
    map: str | None = None
    background: Any = None
    fill: bool = False
    overlay: bool = False
    supersampling: int | None = None
    disparity_scale: tuple[float, float] | None = None
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
        "background": _background,
        "fill": words.truth,
        "overlay": words.truth,
        "supersampling": words.whole(1, 8),
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

    @classmethod
    def _made(cls, entry: dict[str, Any], usual: dict[str, Any]) -> Item:
        if entry.get("edits") is not None:  # which stands in place of the one edit that defaults may have
            usual = {word: value for word, value in usual.items() if word not in SHORT_EDIT}
        elif entry.get("cage") is not None:
            usual.pop("edits", None)
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


# -- words of fits and evaluations


def _options(value: Any, word: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f'{word} must be an object such as {{"quality": "fast"}}, got {shown(value)}')
    return value


def _output(*endings: str) -> Checker:
    def check(value: Any, word: str) -> str:
        if not isinstance(value, str) or not value.lower().endswith(endings):
            raise ValueError(f"{word} must end in {' '.join(endings)}, got {shown(value)}")
        return value

    return check


def _masks(value: Any, word: str) -> bool | str:
    if value == "split" or isinstance(value, bool):
        return value
    raise ValueError(f'{word} must be true, false or "split", got {shown(value)}')


_SCENE_WORDS: dict[str, Checker] = {
    "scene": text,
    "split": text,
    "downscale": words.whole(1),
    "format": text,
    "masks": _masks,
    "cameras": text,
}


@dataclasses.dataclass(frozen=True, eq=False)
class FitItem(Item):
    """A fit of a field to the pictures of a scene.

    Args:
        id: As for `Item`.
        outputs: {"field": file}, and {"cameras": file} where cameras are refined.
        extra: As for `Item`.
        scene: Folder of the scene.
        options: Those of `warpcage.fit`, such as {"quality": "fast", "seed": 3}.
        split: As `load_scene` has it, and so the rest.
        downscale: Factor by which pictures shrink.
        format: Format of the scene. None finds it.
        masks: What mask files are.
        cameras: Camera file of the scene. None takes those of its files.
        background: Colour behind transparent pixels.
        straighten: Whether the scene is turned so that its up is +z.
    """

    scene: str = ""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    split: str = "train"
    downscale: int = 1
    format: str | None = None
    masks: bool | str = True
    cameras: str | None = None
    background: Any = "white"
    straighten: bool = False

    kind: ClassVar[str] = "fit"
    known: ClassVar[dict[str, Checker]] = {
        "id": safe_name,
        "kind": words.anything,
        **_SCENE_WORDS,
        "options": _options,
        "background": _background,
        "straighten": words.truth,
        "output": _output(".npz"),
        "outputs": words.anything,
        "extra": words.anything,
    }

    @property
    def group(self) -> str:
        return f"fit {self.scene}"

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        if "scene" not in given:
            raise ValueError("a fit needs a 'scene', the folder of its pictures")
        given["outputs"] = _single_output(given, "field", ".npz")
        return given


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluateItem(Item):
    """A comparison of a field with pictures of a scene, as `warpcage evaluate` makes it.

    Args:
        id: As for `Item`.
        outputs: {"report": file}.
        extra: As for `Item`.
        field: The field file, voxels.
        scene: Folder of the scene.
        split: As `load_scene` has it, and so the rest.
        downscale: Factor by which pictures shrink.
        format: Format of the scene. None finds it.
        masks: What mask files are.
        cameras: Camera file of the scene. None takes those of its files.
        background: Colour behind the field. None is the field's own.
        tune_cameras: Whether the camera of each view is turned and shifted first so that it matches the field best.
        scene_scale: As `VoxelField.load` has it.
    """

    field: str = ""
    scene: str = ""
    split: str = "test"
    downscale: int = 1
    format: str | None = None
    masks: bool | str = True
    cameras: str | None = None
    background: Any = None
    tune_cameras: bool = False
    scene_scale: float = 1.0

    kind: ClassVar[str] = "evaluate"
    known: ClassVar[dict[str, Checker]] = {
        "id": safe_name,
        "kind": words.anything,
        "field": text,
        **_SCENE_WORDS,
        "background": _background,
        "tune_cameras": words.truth,
        "scene_scale": words.positive,
        "output": _output(".json"),
        "outputs": words.anything,
        "extra": words.anything,
    }

    @property
    def group(self) -> str:
        return f"evaluate {self.field} {digest([self.field, self.scene_scale])}"

    @property
    def pose(self) -> str:
        return self.scene

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        for word in ("field", "scene"):
            if word not in given:
                raise ValueError(f"an evaluation needs a {word!r}")
        given["outputs"] = _single_output(given, "report", ".json")
        return given


def _single_output(given: dict[str, Any], part: str, ending: str) -> dict[str, str]:
    """The one output of a fit or an evaluation, of "output" or of "outputs" as `to_json` writes it."""
    named, several = given.pop("output", None), given.pop("outputs", None)
    if several is not None:
        if named is not None or not isinstance(several, dict) or set(several) != {part}:
            raise ValueError(f"'output' must be one file that ends in {ending}")
        named = _output(ending)(several[part], "'output'")
    return {part: output_path(named or f"{ID}{ending}", given["id"], "'output'")}


#: Items by the word of their kind.
KINDS: dict[str, type[Item]] = {maker.kind: maker for maker in (FrameItem, FitItem, EvaluateItem)}
