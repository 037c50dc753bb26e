"""Items of job files: frames, fits and evaluations, what they say and which files they leave."""

from __future__ import annotations

import abc
import dataclasses
import functools
import hashlib
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from ...core.checks import checked_bounds, checked_number, checked_positive, checked_whole, shown
from ...core.names import TRANSPARENT, coordinate_kind, renamed_keys
from ...core.spec import (
    Checker,
    Values,
    anything,
    checked_keys,
    checked_text,
    checkers,
    flag,
    names_of,
    numbers,
    option,
    options_json,
    positive,
    text,
    whole,
)
from ...edits.spec import EDIT_KEYS, EditSpec, canonical, safe_name
from ...errors import InputError
from ...splats.io import SPLAT_ENDINGS
from ..spec.scene import FitSceneSpec, SceneSpec
from ..spec.shot import DEFORMATION, PRECISE, ShotSpec

#: What stands for an item's id in the names of its outputs.
ID = "{id}"


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Item(abc.ABC):
    """One item of a job."""

    id: str = option(dataclasses.MISSING, Values(safe_name), "a relative name, unique in its job")
    outputs: dict[str, str] = option(
        dataclasses.MISSING,
        Values(anything),
        "files by what they hold, relative to the folder of the run; `output` names the first",
        default_help="`{id}` and the usual ending",
    )
    extra: Any = option(None, Values(anything), "any JSON that is kept with its record")

    #: Its kind's name, JSON keys besides its options, those that it needs, and all kinds.
    kind: ClassVar[str]
    short: ClassVar[dict[str, Checker]]
    needed: ClassVar[dict[str, str]] = {"id": 'an item needs an "id", such as "frame_0001"'}  # messages by missing key
    kinds: ClassVar[dict[str, type[Item]]] = {}

    __eq__, __hash__ = object.__eq__, object.__hash__

    def __init_subclass__(cls) -> None:
        Item.kinds[cls.kind] = cls

    @classmethod
    @functools.cache
    def known(cls) -> dict[str, Checker]:
        """All JSON keys that it takes, with their checks."""
        checks = dict(checkers(cls))
        last = {name: checks.pop(name) for name in ("outputs", "extra")}
        own = {name: checks.pop(name) for name in cls.__annotations__ if name in checks}
        return {"id": checks.pop("id"), "kind": anything} | own | checks | cls.short | last

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
        """The item as JSON, with what it takes from defaults of its file, but without what is usual.
        `from_json` makes an equal item of it."""
        return {"id": self.id, "kind": self.kind, "outputs": dict(self.outputs)} | options_json(self)

    @staticmethod
    def from_json(entry: Mapping[str, Any], defaults: Mapping[str, Any] | Defaults | None = None) -> Item:
        """An item of the kind that it says from JSON; defaults: what holds where that says nothing.
        Keys of other kinds of items are left out of the defaults."""
        if not isinstance(entry, Mapping):
            raise InputError(f"an item must be a JSON object, got {shown(entry)}")
        entry = renamed_keys(entry)
        usual = defaults if isinstance(defaults, Defaults) else Defaults(defaults or {})
        kind = entry.get("kind") or usual.spec.get("kind") or "frame"
        if not isinstance(kind, str) or kind not in Item.kinds:
            raise InputError(f"'kind' must be one of {', '.join(Item.kinds)}, got {shown(kind)}")
        return Item.kinds[kind]._made(entry, usual.of(Item.kinds[kind]))

    @classmethod
    def _made(cls, entry: Mapping[str, Any], usual: dict[str, Any]) -> Item:
        checked = checked_keys(entry, cls.known(), f"an item of kind {cls.kind!r}")
        given = usual | checked
        if len(checked) < len(entry):  # null takes a default away
            given = {key: value for key, value in given.items() if key in checked or key not in entry}
        given.pop("kind", None)
        for key in cls.needed:
            if key not in given:
                raise InputError(cls.needed[key])
        given = cls._completed(given)
        given["outputs"] = {
            part: output_path(path, given["id"], f"{part!r} of 'outputs'") for part, path in given["outputs"].items()
        }
        return cls(**given)

    @classmethod
    @abc.abstractmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        """The arguments of the constructor of checked keys."""


class Defaults:
    """What holds where an item says nothing, checked once for all items of a kind."""

    def __init__(self, spec: Mapping[str, Any]):
        self.spec = renamed_keys(spec)
        self._checked: dict[str, dict[str, Any]] = {}

    def of(self, maker: type[Item]) -> dict[str, Any]:
        """The checked keys that a kind of item takes. Raises ValueError for one that cannot be."""
        if maker.kind not in self._checked:
            usual = {name: value for name, value in self.spec.items() if name in maker.known()}
            self._checked[maker.kind] = checked_keys(usual, maker.known(), "'defaults'")
        return self._checked[maker.kind]


def digest(value: Any) -> str:
    """A short hash of a JSON value: 16 hexadecimal digits."""
    return hashlib.blake2b(canonical(value).encode(), digest_size=8).hexdigest()


def output_path(path: Any, item_id: str, name: str) -> str:
    """A checked name of an output, with the item's id put in. Raises ValueError for others."""
    found = safe_name(path.replace(ID, item_id) if isinstance(path, str) else path, name)
    if found.lower() == "manifest.jsonl":
        raise InputError(f"{name} cannot be {found!r}, which is the run's own")
    return found


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

#: Parts of a frame, and their endings, whose picture may be the mean of moments.
OF_MOMENTS = {"rgb": (".png", ".jpg", ".jpeg", ".exr"), "film": ".npz", "pose": ".npy", "record": ".json"}


def _edits(value: Any, name: str) -> tuple[EditSpec, ...]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{name} must be a list of at least one edit, got {shown(value)}")
    return tuple(EditSpec.from_json(entry, f"edit {number} of {name}") for number, entry in enumerate(value, 1))


def _camera(value: Any, name: str) -> Any:
    if isinstance(value, str) and value:
        return checked_text(value, name)
    if not isinstance(value, dict) or not value:
        raise InputError(
            f"{name} must be an object with {', '.join(_PINHOLE)}, or one with eye, target, width and height; or "
            f'"cameras.json#NAME" or "transforms.json#3", got {shown(value)}'
        )
    if "eye" in value or ("target" in value and "camera_to_world" not in value):
        checked_keys(value, _LOOKING, name)
    needed = {name: each for name, each in _LOOKING.items() if name not in _USUAL} if "eye" in value else _PINHOLE
    for key, check in needed.items():
        if value.get(key) is None:
            raise InputError(f"{name} lacks {key!r}")
        check(value[key], f"{key!r} of {name}")
    return value


def _pose(value: Any, name: str) -> Any:
    if not isinstance(value, list) or len(value) != 4:
        raise InputError(f"{name} must be four rows of four numbers, got {shown(value)}")
    return [numbers(row, f"a row of {name}", 4) for row in value]


_SIDE = whole(1, 65_536).check

#: A camera as files of cameras have it, and one that looks from a place to another, of which two keys may be left out.
_PINHOLE: dict[str, Checker] = {
    **dict.fromkeys(("fx", "fy"), checked_positive),
    **dict.fromkeys(("cx", "cy"), checked_number),
    **dict.fromkeys(("width", "height"), _SIDE),
    "camera_to_world": _pose,
}

_LOOKING: dict[str, Checker] = {
    **dict.fromkeys(("eye", "target", "up"), functools.partial(numbers, count=3)),
    "fov_degrees": checked_positive,
    **dict.fromkeys(("width", "height"), _SIDE),
}

_USUAL = ("up", "fov_degrees")


def _poses(value: Any, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{name} must be a list of a pose for each edit, null where it removes, got {shown(value)}")
    return [None if each is None else EDIT_KEYS["posed"](each, f"a pose of {name}") for each in value]


_MOMENT: dict[str, Checker] = {"camera": _camera, "posed": _poses}


def _moments(value: Any, name: str) -> tuple[dict[str, Any], ...]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{name} must be a list of objects with a 'camera', 'posed', or both, got {shown(value)}")
    return tuple(checked_keys(each, _MOMENT, f"moment {number} of {name}") for number, each in enumerate(value, 1))


def _size(value: Any, name: str) -> tuple[int, ...]:
    sides = value if isinstance(value, list | tuple) else [value]
    if not 1 <= len(sides) <= 2:
        raise InputError(f"{name} must be a width, or [width, height], in pixels, got {shown(value)}")
    return tuple(_SIDE(side, name) for side in sides)


def _output(*endings: str) -> Checker:
    def check(value: Any, name: str) -> str:
        if not isinstance(value, str) or not value.lower().endswith(endings):
            raise InputError(f"{name} must end in {' '.join(endings)}, got {shown(value)}")
        return value

    return check


def _frame_outputs(value: Any, name: str) -> dict[str, str]:
    if not isinstance(value, dict) or not value:
        raise InputError(f'{name} must be an object such as {{"rgb": "{ID}.png", "depth": "{ID}.npy"}}')
    for part, path in value.items():
        if part not in PART_ENDINGS:
            raise InputError(f"{name} has no {shown(part)}, only {', '.join(PART_ENDINGS)}")
        _output(*PART_ENDINGS[part])(path, f"{part!r} of {name}")
    return dict(value)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FrameItem(Item, ShotSpec):
    """A picture of a field, as it is or deformed. Parts of outputs: see PART_ENDINGS; film: colours for films of
    16 bits; pose: vertices of its posed cages; record: what `jobs.worker.frame_record` says of it."""

    outputs: dict[str, str] = option(
        dataclasses.MISSING,
        Values(_frame_outputs),
        "files by the part of the frame that they hold",
        default_help=f'`{{"rgb": "{ID}.png"}}`',
    )
    field: str = option(
        "",
        text(),
        "field file, voxels (`.npz`) or splats, or an output folder of 3D Gaussian Splatting",
        default_help="needed",
    )
    camera: Any = option(None, Values(_camera), "an object, or a reference to one in a file", default_help="needed")
    edits: tuple[EditSpec, ...] = option(
        (), Values(_edits), "a list of edits in the order in which they act", default_help="the field as it is"
    )
    size: tuple[int, ...] = option(
        (),
        Values(_size),
        "width, or `[width, height]`, of the picture, cut from the camera's where its shape is another",
        default_help="the camera's own",
    )
    moments: tuple[dict[str, Any], ...] = option(
        (),
        Values(_moments),
        "a list of moments of a shutter. Each may have a `camera`, and a `posed` that lists a pose for each edit, "
        "`null` where it removes; what it leaves out is the item's. The picture is the mean of theirs in linear light",
        default_help="one moment, the item",
        since=3,
    )

    kind: ClassVar[str] = "frame"
    short: ClassVar[dict[str, Checker]] = EDIT_KEYS  # of one edit
    needed: ClassVar = Item.needed | {key: f"a frame needs a {key!r}" for key in ("field", "camera")}

    @property
    def group(self) -> str:
        loaded = [self.field, self.scene_scale, *([edit.rest for edit in self.edits] or [None])]
        how = [getattr(self, name) for name in names_of(ShotSpec, DEFORMATION)] if self.edits else []
        return f"frame {self.field} {digest(loaded + how)}"

    @property
    def pose(self) -> str:
        return digest([edit.posed for edit in self.edits]) if self.edits else ""

    @property
    def shots(self) -> list[FrameItem]:
        """What is rendered for its picture: itself, or its moments, of which the picture is the mean."""
        return [self._at(moment) for moment in self.moments] or [self]

    def _at(self, moment: Mapping[str, Any]) -> FrameItem:
        poses = moment.get("posed") or [edit.posed for edit in self.edits]
        edits = [dataclasses.replace(edit, posed=posed) for edit, posed in zip(self.edits, poses, strict=True)]
        return dataclasses.replace(self, camera=moment.get("camera", self.camera), edits=tuple(edits), moments=())

    @classmethod
    def _made(cls, entry: Mapping[str, Any], usual: dict[str, Any]) -> Item:
        if entry.get("edits") is not None:  # which stands in place of the one edit that defaults may have
            usual = {name: value for name, value in usual.items() if name not in cls.short}
        elif entry.get("cage") is not None:
            usual = {name: value for name, value in usual.items() if name != "edits"}
        item: Any = super()._made(entry, usual)
        item.check()
        return item

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        short = {name: given.pop(name) for name in cls.short if name in given}
        if short and "edits" in given:
            raise InputError(f"{next(iter(short))!r} and 'edits' do not go together: put it into one of the edits")
        if short:
            if "cage" not in short:
                raise InputError(f"{next(iter(short))!r} needs a 'cage', the cage at rest")
            given["edits"] = (EditSpec(**short),)
        given.setdefault("outputs", {"rgb": f"{ID}.png"})
        return given

    def check(self, named: Callable[[str], str] = repr) -> None:
        outputs = self.outputs
        if any(edit.held != "cut" and not edit.falloff for edit in self.edits):
            raise InputError("'held' names the sides that an edit fades towards: give it a 'falloff' too")
        if len(set(outputs.values())) < len(outputs):
            raise InputError(f"two of the 'outputs' are one file: {', '.join(outputs.values())}")
        needing = [part for part in ("masks", "reveal", "fold", "outside") if part in outputs]
        needing += [name for name in ("fill", "overlay") if getattr(self, name)]
        if needing and not self.edits:
            raise InputError(f"{needing[0]!r} needs a deformation: 'cage' and 'posed', or 'edits'")
        removed = [edit.remove for edit in self.edits]
        for number, moment in enumerate(self.moments, 1):
            if "posed" in moment and [pose is None for pose in moment["posed"]] != removed:
                raise InputError(f"moment {number} of 'moments' needs a pose for each edit, null for one that removes")
            if sharp := [path for part, path in outputs.items() if not path.lower().endswith(OF_MOMENTS.get(part, ()))]:
                raise InputError(f"'moments' blur pictures in colours: leave {sharp[0]!r} of 'outputs' out")
        if self.resolution == PRECISE:
            coordinate_kind(self.coordinates).require_precise("give 'resolution' a number, or leave it out")
        if self.background == TRANSPARENT and outputs.get("rgb", "").lower().endswith((".jpg", ".jpeg")):
            raise InputError("a JPEG has no opacity: write a .png or .exr, or name another 'background'")
        super().check(named)


def _options(value: Any, name: str) -> dict[str, Any]:
    from ...fitting.fit import REPRESENTATIONS  # these need Warp
    from ...fitting.options import checked_options
    from ...fitting.splats.options import checked_splat_options

    if not isinstance(value, dict):
        raise InputError(f'{name} must be an object such as {{"quality": "fast"}}, got {shown(value)}')
    kind = value.get("representation", "voxels")
    if kind not in REPRESENTATIONS or (kind == "splats" and "bounds" in value):
        raise InputError(f"{name}: 'representation' must be voxels, or splats without 'bounds', got {shown(kind)}")
    try:
        check = checked_options if kind == "voxels" else checked_splat_options
        check({name: each for name, each in value.items() if name not in ("seed", "bounds", "representation")})
        checked_whole(value.get("seed", 0), "the seed", 0)
        if value.get("bounds") is not None:
            checked_bounds(value["bounds"])
    except (ValueError, TypeError) as error:
        raise InputError(f"{name}: {error}") from None
    return value


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FitItem(Item, FitSceneSpec):
    """A fit of a field to the pictures of a scene; outputs: {"field": file}, and {"cameras": file} where refined."""

    scene: str = option("", text(), "folder of its pictures", default_help="needed")
    options: dict[str, Any] = option({}, Values(_options), "an object of options of `warpcage.fit`")

    kind: ClassVar[str] = "fit"
    short: ClassVar[dict[str, Checker]] = {"output": _output(".npz", *SPLAT_ENDINGS)}
    needed: ClassVar = Item.needed | {"scene": "a fit needs a 'scene', the folder of its pictures"}

    @property
    def group(self) -> str:
        return f"fit {self.scene}"

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        options = given.get("options", {})
        if options.get("representation") == "splats":
            return _with_outputs(given, ".ply", field=SPLAT_ENDINGS)
        refined = options.get("refine_cameras") is True  # of "auto" it is not known
        return _with_outputs(given, ".npz", field=(".npz",), **({"cameras": (".cameras.json",)} if refined else {}))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class EvaluateItem(Item, SceneSpec):
    """A comparison of a field with pictures of a scene, as `warpcage evaluate` makes it; outputs: {"report": file}."""

    field: str = option("", text(), "field file", default_help="needed")
    scene: str = option("", text(), "folder of its pictures", default_help="needed")
    split: str = option("test", text(), "which pictures of the scene")
    given_cameras: bool = option(False, flag(), "whether cameras stay where those of the fit were refined")
    tune_cameras: bool = option(False, flag(), "whether each view's camera is moved first, to match the field best")
    scene_scale: float = option(1.0, positive(), "as of a frame")

    kind: ClassVar[str] = "evaluate"
    short: ClassVar[dict[str, Checker]] = {"output": _output(".json")}
    needed: ClassVar = Item.needed | {key: f"an evaluation needs a {key!r}" for key in ("field", "scene")}

    @property
    def group(self) -> str:
        return f"evaluate {self.field} {digest([self.field, self.scene_scale])}"

    @property
    def pose(self) -> str:
        return self.scene

    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        return _with_outputs(given, ".json", report=(".json",))


def _with_outputs(given: dict[str, Any], usual: str, **endings: tuple[str, ...]) -> dict[str, Any]:
    """The keys of a fit or an evaluation with "outputs", of "output", the first of them, or as `to_json` writes it.
    endings: those that the file of each part may have; usual: of the first."""
    named, several = given.pop("output", None), given.pop("outputs", None)
    first, *others = endings
    if named is not None:
        _output(*endings[first])(named, "'output'")
    if several is None:
        named = named or ID + usual
        several = {first: named} | {part: named[: -len(usual)] + endings[part][0] for part in others}
    elif named is not None or not isinstance(several, dict) or set(several) != set(endings):
        raise InputError(f"'outputs' must be an object of {', '.join(endings)}, without 'output' beside it")
    for part, path in several.items():
        _output(*endings[part])(path, f"{part!r} of 'outputs'")
    return given | {"outputs": several}


#: Kinds of records, as "records" of a job's header has them.
FOLDER, WEBDATASET = "folder", "webdataset"

#: What lists the frames of a folder.
TRANSFORMS = "transforms.json"


def record_outputs(records: Mapping[str, Any]) -> dict[str, str]:
    """The files of each item of a job with records: names by part, with `{id}` where the item's id goes."""
    endings = {"depth": ".depth.npy", "alpha": ".alpha.png", "pose": ".pose.npy", "record": ".json"}
    chosen = {part: ID + ending for part, ending in endings.items() if records.get(part, True)}
    return {"rgb": f"{ID}.{records.get('image', 'png')}"} | chosen


def checked_item(entry: Mapping[str, Any], defaults: Defaults, records: Mapping[str, Any]) -> Item:
    """An item of a job of the object of its line; records: "records" of the header, which are frames alone, without
    outputs of their own, or an id that a data set would cut or has itself."""
    if not records:
        return Item.from_json(entry, defaults)
    kind = entry.get("kind") or defaults.spec.get("kind") or FrameItem.kind
    if kind != FrameItem.kind:
        raise InputError(f"'records' are of frames: an item of kind {shown(kind)} belongs into another job")
    item = Item.from_json(entry, defaults)
    expected = {part: path.replace(ID, item.id) for part, path in record_outputs(records).items()}
    if entry.get("outputs") is not None and item.outputs != expected:
        raise InputError("'records' of the header say what is written: leave 'outputs' out")
    name = item.id.rpartition("/")[2]
    if records["kind"] == FOLDER and f"{name}.json" == TRANSFORMS:
        raise InputError(f"a folder of records has a {TRANSFORMS} of its own: call it something else")
    if records["kind"] == WEBDATASET and "." in name:
        raise InputError(f"a WebDataset cuts names at their first dot: call it {name.replace('.', '_')!r}")
    return item
