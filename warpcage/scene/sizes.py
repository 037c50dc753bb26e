"""Pictures as readers of formats find them, and their sizes: upright, in smaller copies, as their cameras say."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from ..core.checks import warn_caller
from ..errors import InputError
from ..view.pictures import image_size, is_on_its_side
from .lenses import Intrinsics, Lens, Part
from .parsing import is_file, smaller_copies

#: Width and height, pixels.
Size = tuple[int, int]


@dataclasses.dataclass
class View:
    """One picture and its camera, as a format's reader found them."""

    file: pathlib.Path
    pose: np.ndarray  # (4, 4) camera to world, OpenCV axes
    where: str  # file and field, for messages
    # pixels of the file, the centre of the first one at (0.5, 0.5); or a function of the picture's width and height
    intrinsics: Intrinsics | Callable[[Size], Intrinsics]
    size: Size | None = None  # width and height that the format claims
    distortion: tuple[float, ...] = ()  # in the order of COEFFICIENTS
    mask: pathlib.Path | None = None  # picture of the opacity
    counted: pathlib.Path | None = None  # picture of how much each pixel counts
    ignored: pathlib.Path | None = None  # picture of what does not count: all that is not black
    lens: Lens | None = None  # in place of distortion: a lens whose picture becomes pinhole views
    part: Part | None = None  # which of these views it is
    turned: frozenset[pathlib.Path] = frozenset()  # files that are made upright, as the camera is

    @property
    def files(self) -> list[pathlib.Path]:
        """All pictures that the view is made of."""
        return [self.file, *self.mask_files]

    @property
    def mask_files(self) -> list[pathlib.Path]:
        """Pictures of the same size that say something of the pixels."""
        return [file for file in (self.mask, self.counted, self.ignored) if file is not None]

    @property
    def is_counted(self) -> bool:
        """Whether some pixels may count less than others."""
        return self.counted is not None or self.ignored is not None or self.part is not None

    def intrinsics_of(self, size: Size) -> Intrinsics:
        """(fx, fy, cx, cy) of its picture of some size."""
        fx, fy, cx, cy = self.intrinsics(size) if callable(self.intrinsics) else self.intrinsics
        return float(fx), float(fy), float(cx), float(cy)


_Given = TypeVar("_Given")
_Found = TypeVar("_Found")

#: What is cut off pictures so that all of a scene have one size, pixels, and as a share of the smallest, at most.
MAX_CUT, MAX_CUT_SHARE = 2, 0.01

#: Pixels by which sides of pictures that were made smaller miss a common factor, as sides are rounded either way.
ROUNDING = 1.01

#: Factors between these are those of crops, and of pictures whose lens was undone, as often as of smaller pictures.
CROPS = (0.8, 1.25)


def chosen_copy(copies: Mapping[int, pathlib.Path], downscale: int, folder: pathlib.Path) -> tuple[int, int]:
    """Which folder of a scene's pictures, by how many times they are smaller, is read for a downscale, and by how much
    it is shrunk: the nearest that is not smaller. It warns where pictures become smaller than requested."""
    known = sorted(copies)
    fitting = [factor for factor in known if downscale % factor == 0]
    smaller = [factor for factor in known if factor > downscale]
    factor = fitting[-1] if fitting else smaller[0] if smaller else known[-1]
    rest = -(-downscale // factor)
    if factor * rest != downscale:
        warn_caller(
            f"{folder} holds its pictures smaller alone ({', '.join(copies[each].name for each in known)}): "
            f"{copies[factor].name} is read, which makes them {factor * rest} times smaller; cameras are scaled"
        )
    return factor, rest


def of_copies(
    folder: pathlib.Path, views: list[View], beside: Sequence[pathlib.Path], downscale: int
) -> tuple[list[View], Sequence[pathlib.Path], int, int]:
    """Views, and pictures beside them, of smaller copies in images_4/ where images/ has none of them; the downscale
    that is left to do, and by how many times the copies are smaller."""
    if any(is_file(view.file) for view in views):
        return views, beside, downscale, 1
    copies = [smaller_copies(view.file, folder) for view in views]
    shared = set.intersection(*map(set, copies)) if copies else set()
    if not shared:  # what is missing is refused when it is opened
        return views, beside, downscale, 1
    folders = {factor: pathlib.Path(f"images_{factor}") for factor in shared}
    factor, rest = chosen_copy(folders, downscale, folder)
    views = [dataclasses.replace(view, file=copy[factor]) for view, copy in zip(views, copies, strict=True)]
    return views, [smaller_copies(file, folder).get(factor, file) for file in beside], rest, factor


def upright(views: list[View]) -> list[View]:
    """The views with the files of theirs that must be turned to have the width and height of the camera, which their
    orientation tags say: pictures, and masks that were not turned before."""
    return [
        view
        if view.size is None
        else dataclasses.replace(view, turned=frozenset(file for file in view.files if _is_turned(file, view.size)))
        for view in views
    ]


def _is_turned(file: pathlib.Path, size: Size) -> bool:
    """Whether a picture is on its side, and upright has a size that it has not."""
    found = image_size(file)
    return found != tuple(size) and found[::-1] == tuple(size) and is_on_its_side(file)


def fitted_sizes(views: list[View], factor: int, folder: pathlib.Path) -> tuple[list[View], list[Size]]:
    """The views with cameras for the sizes that their pictures have by their headers, once they are upright, and these
    sizes; masks must have the same. factor: by how many times copies are smaller, see `of_copies`."""

    def size_of(view: View, file: pathlib.Path) -> Size:
        width, height = image_size(file)
        return (height, width) if file in view.turned else (width, height)

    sizes = _at_once(lambda view: size_of(view, view.file), views)
    for view, size in zip(views, sizes, strict=True):
        for mask in view.mask_files:
            if size_of(view, mask) != size:
                raise InputError(
                    f"{view.where}: mask {mask.name!r} is {times(size_of(view, mask))}, its image {view.file.name!r} "
                    f"is {times(size)}"
                )
    return _scaled(views, sizes, factor, folder), sizes


def _at_once(function: Callable[[_Given], _Found], items: Iterable[_Given]) -> list[_Found]:
    with ThreadPoolExecutor() as pool:
        return list(pool.map(function, items))


def _scaled(views: list[View], sizes: list[Size], factor: int, folder: pathlib.Path) -> list[View]:
    """The views with their cameras scaled to the sizes of their pictures, where all of these are smaller or larger by
    one factor; ValueError where they are of other sizes."""
    claimed = [view.size or (size[0] * factor, size[1] * factor) for view, size in zip(views, sizes, strict=True)]
    wrong = [index for index, size in enumerate(sizes) if size != tuple(claimed[index])]
    if not wrong and factor == 1:
        return views
    share = _common_share(claimed, sizes)
    if share is None or (factor == 1 and not _is_resized(views, share)):
        raise InputError(_other_size(views, sizes, wrong))
    if share != 1 / factor:
        warn_caller(
            f"{folder}: pictures are {share:.4g} times as large as their cameras are for, {times(sizes[0])} for "
            f"{times(claimed[0])}, all alike: cameras are scaled"
        )
    return [_scaled_view(view, *each) for view, *each in zip(views, claimed, sizes, strict=True)]


def _common_share(claimed: list[Size], sizes: list[Size]) -> float | None:
    """By how much all sizes are those that cameras claim, but for rounded sides; None where they are not. One of 1 / k
    is taken where it fits."""
    if not all(1 <= side < 1e6 for size in claimed for side in size):
        return None
    before, after = np.array(claimed, float), np.array(sizes, float)
    share = float(after.sum() / before.sum())
    nearest = round(share) if share > 1 else 1 / round(1 / share)
    for each in (nearest, share):
        if (np.abs(after - each * before) <= ROUNDING * max(1.0, each)).all():
            return each
    return None


def _is_resized(views: list[View], share: float) -> bool:
    """Whether pictures of a common share of the size that cameras are for are these pictures, made smaller or larger:
    by a whole factor, or by much and without a lens that may have been undone, as undoing one crops them."""
    is_whole = share != 1 and (share if share > 1 else 1 / share) == round(share if share > 1 else 1 / share)
    is_bent = any(view.lens is not None or any(view.distortion) for view in views)
    return is_whole or (not is_bent and not CROPS[0] <= share <= CROPS[1])


def _other_size(views: list[View], sizes: list[Size], wrong: list[int]) -> str:
    """The message for pictures of which some have another size than their cameras are for."""
    view, size = views[wrong[0]], sizes[wrong[0]]
    assert view.size is not None
    said = f"{view.where}: the camera is for {times(view.size)} pixels, image {view.file.name!r} has {times(size)}"
    if size[::-1] == tuple(view.size):
        return f"{said}, which is on its side and has no tag that says which: turn the file by a quarter"
    return (
        f"{said}; sizes differ in {len(wrong)} of {len(views)} pictures, by no factor which says that they were made "
        "smaller: give the pictures that the cameras are of (before a lens was undone, or after)"
    )


def _scaled_view(view: View, claimed: Size, size: Size) -> View:
    """A view with its camera, which is for the claimed size, for a picture of another size."""
    across, down = size[0] / claimed[0], size[1] / claimed[1]

    def intrinsics(actual: Size) -> Intrinsics:  # of the size of the file, or of what is asked of sizes not known
        fx, fy, cx, cy = view.intrinsics_of((round(actual[0] / across), round(actual[1] / down)))
        return fx * across, fy * down, cx * across, cy * down

    return dataclasses.replace(view, intrinsics=intrinsics, size=None if view.size is None else size)


def sizes_there(files: Sequence[pathlib.Path], *, upright: bool) -> list[Size]:
    """Sizes of pictures of other splits that can be read: errors of the rest are raised with their split.
    upright: whether pictures on their side are turned."""

    def size_of(file: pathlib.Path) -> Size | None:
        try:
            width, height = image_size(file)
            return (height, width) if upright and is_on_its_side(file) else (width, height)
        except (ValueError, OSError):
            return None

    return [size for size in _at_once(size_of, files) if size is not None]


def frames_of_sizes(sizes: list[Size], others: list[Size]) -> tuple[list[Size], Size]:
    """Width and height that are taken of each picture, from its upper left, and those that hold all of a scene's."""
    # COLMAP's undistorter rounds the sizes of cameras that are almost the same: a few pixels are cut off, and all
    # pictures count as a whole. Others keep their size.
    everything = np.array([*sizes, *others])
    least, most = everything.min(axis=0), everything.max(axis=0)
    if (most - least <= np.maximum(MAX_CUT, MAX_CUT_SHARE * least)).all():
        return [(int(least[0]), int(least[1]))] * len(sizes), (int(least[0]), int(least[1]))
    return sizes, (int(most[0]), int(most[1]))


def require_known_sizes(views: list[View], sizes: list[Size]) -> None:
    """Refuse pictures of several sizes where nothing says for which of them a camera in pixels is."""
    usual = max(sizes, key=sizes.count)
    other = next((index for index, size in enumerate(sizes) if size != usual), None)
    for view, size in zip(views, sizes, strict=True):
        doubled = (2 * size[0], 2 * size[1])
        if (
            other is not None
            and view.size is None
            and view.part is None
            and view.intrinsics_of(size) == view.intrinsics_of(doubled)
        ):
            raise InputError(
                f"{view.where}: nothing says the size that the camera is for, and pictures must have one size: "
                f"{views[other].file.name!r} is {times(sizes[other])}, others are {times(usual)}"
            )


def times(size: Size) -> str:
    """A size in messages."""
    return f"{size[0]}x{size[1]}"
