"""Masks of a scene's pictures: their files, by one rule for all formats, and the opacities that they hold."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import re
from collections.abc import Sequence

import numpy as np

from ..core.checks import listed, warn_caller
from ..errors import InputError
from ..view.pictures import Rows
from .parsing import DYNAMIC_MASK, PICTURE_ENDINGS, is_file
from .sizes import View

#: Masks that are nowhere brighter hold numbers of objects, 0 and 1 at the least: what is not 0 is kept. Colours
#: that differ by more are no grey.
DARK = 0.1

#: Folders of splits, of which each may have a picture of some name.
SPLITS = ("train", "val", "validation", "test")

#: Rows of a mask that are looked at together.
STRIP = 256


def with_masks(
    folder: pathlib.Path,
    views: list[View],
    masks: bool | str,
    beside: Sequence[pathlib.Path],
    *,
    home: pathlib.Path | None = None,
) -> list[View]:
    """Views with their masks, as `load_scene` describes `masks`, and those of ignored pixels. beside: pictures of other
    splits, to distinguish masks of the same names; home: the folder of masks, None finds it."""
    if not masks:
        return [dataclasses.replace(view, mask=None) for view in views]
    if all(view.mask is None for view in views):
        views = _with_named_masks(folder, views, beside, home)

    def with_ignored(view: View) -> View:
        dynamic = view.file.with_name(f"{DYNAMIC_MASK}{view.file.stem}.png")
        ignored = dynamic if is_file(dynamic) else None
        if masks == "weights":
            return dataclasses.replace(view, mask=None, counted=view.mask, ignored=ignored)
        return dataclasses.replace(view, ignored=ignored)

    return [with_ignored(view) for view in views]


def _with_named_masks(
    folder: pathlib.Path, views: list[View], beside: Sequence[pathlib.Path], given: pathlib.Path | None
) -> list[View]:
    """Views with the files of masks/ that have their names; it warns of masks that are not used."""
    files = list(dict.fromkeys([*(view.file for view in views), *beside]))
    if not files or not all(file.is_relative_to(folder) for file in files):
        return views
    common = pathlib.Path(os.path.commonpath([file.parent for file in files]))
    around = [each for each in (common, *common.parents) if each.is_relative_to(folder)]  # from the pictures outwards
    homes = [given] if given else [home for each in around for home in _mask_folders(each, common) if home.is_dir()]
    found: dict[pathlib.Path, pathlib.Path] = {}
    there = {home: _masks_in(home) for home in homes}
    starts = {home: _starts(home, around) for home in homes}
    for file in files:
        named = ((masks, str(file.relative_to(start))) for home, masks in there.items() for start in starts[home])
        mask = next(filter(None, (_mask_of(name, masks) for masks, name in named)), None)
        if mask is not None:
            found[file] = mask
    _require_own(found)
    _warn_of_unused(views, files, found, there, starts)
    return [dataclasses.replace(view, mask=found.get(view.file)) for view in views]


def _starts(home: pathlib.Path, around: list[pathlib.Path]) -> list[pathlib.Path]:
    """Folders around the pictures that names in a folder of masks may begin in, the outermost first: those that hold
    train/ where test/ is beside it, unless masks lie in train/ themselves, as pictures of both may have one name."""
    split = next((each for each in around if each.name in SPLITS and _has_other_split(each)), None)
    return [
        each for each in around[::-1] if split is None or home.is_relative_to(split) or not each.is_relative_to(split)
    ]


def _has_other_split(folder: pathlib.Path) -> bool:
    return any(folder.with_name(name).is_dir() for name in SPLITS if name != folder.name)


def _mask_folders(folder: pathlib.Path, pictures: pathlib.Path) -> list[pathlib.Path]:
    """Where masks lie in a folder: for pictures of images_4/ in masks_4/ first."""
    number = re.fullmatch(r"images(_[0-9]+)", pictures.name)
    return [folder / name for name in ([f"masks{number[1]}"] if number else []) + ["masks"]]


def _masks_in(home: pathlib.Path) -> dict[str, dict[str, pathlib.Path]]:
    """The pictures of a folder of masks, by their paths in it without the ending, and then by their endings."""
    found: dict[str, dict[str, pathlib.Path]] = {}
    for folder, _, names in os.walk(home):
        for name in sorted(names):
            path = pathlib.Path(folder, name)
            if path.suffix.lower() in PICTURE_ENDINGS:
                found.setdefault(str(path.relative_to(home).with_suffix("")), {})[path.suffix.lower()] = path
    return found


def _mask_of(name: str, masks: dict[str, dict[str, pathlib.Path]]) -> pathlib.Path | None:
    """The mask of a picture of some path: NAME.jpg.png, NAME.jpg, or NAME with another ending of pictures."""
    stem, ending = os.path.splitext(name)
    whole, same = masks.get(name, {}), masks.get(stem, {})
    candidates = [whole.get(".png"), same.get(ending.lower()), *(same.get(each) for each in PICTURE_ENDINGS)]
    return next(filter(None, candidates), None)


def _require_own(found: dict[pathlib.Path, pathlib.Path]) -> None:
    """Refuse a mask that has the name of two pictures, such as a.png for a.jpg and a.png."""
    owners: dict[pathlib.Path, pathlib.Path] = {}
    for file, mask in found.items():
        other = owners.setdefault(mask, file)
        if other != file:
            raise InputError(
                f"mask {str(mask)!r} has the name of two pictures, {other.name!r} and {file.name!r}: give each "
                f"its own, {other.name + '.png'!r} and {file.name + '.png'!r}"
            )


def _warn_of_unused(
    views: list[View],
    files: list[pathlib.Path],
    found: dict[pathlib.Path, pathlib.Path],
    there: dict[pathlib.Path, dict[str, dict[str, pathlib.Path]]],
    starts: dict[pathlib.Path, list[pathlib.Path]],
) -> None:
    """Warn of masks of which none has the name of a picture, and of pictures without one beside others that have."""
    if not found:
        for home, masks in there.items():
            first = files[0].relative_to(starts[home][-1])
            held = [path.name for endings in masks.values() for path in endings.values()]
            if held or next(home.iterdir(), None) is not None:
                warn_caller(
                    f"{home} is not used: none of its pictures has the name of one of the scene's; it holds "
                    f"{listed(held, 3, none='no pictures')}, {first.with_suffix('.png')} or {first}.png would be the "
                    f"mask of {first}"
                )
        return
    without = [view.file for view in views if view.file not in found]
    if without:
        warn_caller(
            f"{next(iter(there))} holds no mask for {len(without)} of {len(views)} pictures, the first is "
            f"{without[0].name!r}: they are read whole"
        )


def opacity_rows(rows: Rows) -> Rows:
    """Rows of a mask as opacities (k, l, 1): its grey, and less where its own alpha is; the alpha alone where it is a
    cutout, of colours or of black. Of colours, and of numbers of objects (0 and 1), all that is not black is kept."""
    brightest, least_alpha, is_colored = 0.0, 1.0, False
    first, part = 0, rows(0, STRIP)
    while len(part):
        colors, alpha = _split(part)
        brightest, least_alpha = max(brightest, float(colors.max())), min(least_alpha, float(alpha.min()))
        is_colored = is_colored or bool((colors.max(axis=-1) - colors.min(axis=-1) > DARK).any())
        first += len(part)
        part = rows(first, first + STRIP)
    is_cutout = least_alpha < 1.0 and (is_colored or brightest == 0.0)
    least = 0.0 if brightest < DARK else DARK

    def opacities(first: int, last: int | None) -> np.ndarray:
        colors, alpha = _split(rows(first, last))
        if is_cutout:
            return alpha
        if is_colored or brightest < DARK:
            return (colors.max(axis=-1, keepdims=True) > least) * alpha
        return colors[..., :1] * alpha

    return opacities


def _split(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (k, l, 1 or 3) and alpha (k, l, 1) of rows of a picture."""
    if rows.shape[-1] in (2, 4):
        return rows[..., :-1], rows[..., -1:]
    return rows, np.ones_like(rows[..., :1])
