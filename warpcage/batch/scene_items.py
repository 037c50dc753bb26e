"""Items that read the pictures of a scene: fits and evaluations."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from ..core.checks import checked_bounds, shown
from . import words
from .item import ID, Item, digest, output_path
from .words import Checker, safe_name, text


def _options(value: Any, word: str) -> dict[str, Any]:
    from ..fitting.options import checked_options, checked_seed  # which needs Warp

    if not isinstance(value, dict):
        raise ValueError(f'{word} must be an object such as {{"quality": "fast"}}, got {shown(value)}')
    try:
        checked_options({name: each for name, each in value.items() if name not in ("seed", "bounds")})
        checked_seed(value.get("seed", 0))
        if value.get("bounds") is not None:
            checked_bounds(value["bounds"])
    except (ValueError, TypeError) as error:
        raise ValueError(f"{word}: {error}") from None
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
    """A fit of a field to the pictures of a scene."""

    # Outputs: {"field": file}, and {"cameras": file} where cameras are refined.

    # folder
    scene: str = ""
    # those of `warpcage.fit`, such as {"quality": "fast", "seed": 3}
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    # as `load_scene` has it, and so the rest
    split: str = "train"
    # factor by which pictures shrink
    downscale: int = 1
    # None finds it
    format: str | None = None
    # what mask files are
    masks: bool | str = True
    # camera file of the scene; None takes those of its files
    cameras: str | None = None
    # colour behind transparent pixels
    background: Any = "white"
    # whether the scene is turned so that its up is +z
    straighten: bool = False

    kind: ClassVar[str] = "fit"
    known: ClassVar[dict[str, Checker]] = {
        "id": safe_name,
        "kind": words.anything,
        **_SCENE_WORDS,
        "options": _options,
        "background": words.colour,
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
        refined = bool(given.get("options", {}).get("refine_cameras"))
        given["outputs"] = _outputs(given, {"field": ".npz"} | ({"cameras": ".cameras.json"} if refined else {}))
        return given


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluateItem(Item):
    """A comparison of a field with pictures of a scene, as `warpcage evaluate` makes it."""

    # Outputs: {"report": file}.

    # a file, voxels
    field: str = ""
    # folder
    scene: str = ""
    # as `load_scene` has it, and so the rest
    split: str = "test"
    # factor by which pictures shrink
    downscale: int = 1
    # None finds it
    format: str | None = None
    # what mask files are
    masks: bool | str = True
    # camera file of the scene; None takes those of its files
    cameras: str | None = None
    # colour behind the field; None is the field's own
    background: Any = None
    # whether the camera of each view is turned and shifted first so that it matches the field best
    tune_cameras: bool = False
    # as `VoxelField.load` has it
    scene_scale: float = 1.0

    kind: ClassVar[str] = "evaluate"
    known: ClassVar[dict[str, Checker]] = {
        "id": safe_name,
        "kind": words.anything,
        "field": text,
        **_SCENE_WORDS,
        "background": words.colour,
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
        given["outputs"] = _outputs(given, {"report": ".json"})
        return given


def _outputs(given: dict[str, Any], endings: dict[str, str]) -> dict[str, str]:
    """The outputs of a fit or an evaluation, of "output", the first of them, or of "outputs" as `to_json` writes it."""
    named, several = given.pop("output", None), given.pop("outputs", None)
    (first, ending), *others = endings.items()
    if several is None:
        named = named or f"{ID}{ending}"
        several = {first: named} | {part: named[: -len(ending)] + each for part, each in others}
    elif named is not None or not isinstance(several, dict) or set(several) != set(endings):
        raise ValueError(f"'outputs' must be an object of {', '.join(endings)}, without 'output' beside it")
    for part, path in several.items():
        _output(endings[part])(path, f"{part!r} of 'outputs'")
    return {part: output_path(path, given["id"], f"{part!r} of 'outputs'") for part, path in several.items()}
