"""What of pictures counts where cameras are looked for: not what masks hide, nor what stands still on a turntable."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ...core.checks import checked_path
from ...core.files import atomic_path, seen_note
from ...core.threads import cpu_threads, run_parallel
from ...errors import InputError, MissingFileError
from ...scene.masks import opacity_rows, with_masks
from ...scene.sizes import View
from ...view.pictures import TURNS, is_on_its_side, read_image
from .sources import ENDINGS, ORIENTATION, Source, load_upright

#: A feature is compared with those of so many other pictures, evenly chosen.
OTHERS = 16

#: It stands still where so many of them, and so large a share, have the same at the same pixel: within so many pixels
#: of the shrunk pictures, and with a cosine between descriptors (SIFT's, of length 1) of at least this.
MIN_SAME, SAME_SHARE, SAME_PLACE, SAME_COSINE = 2, 0.15, 1.0, 0.9


@dataclasses.dataclass(frozen=True)
class PictureMask:
    """The files that say what of a picture counts."""

    opacity: pathlib.Path | None = None  # what is black is cut away, as `load_scene` has it
    ignored: pathlib.Path | None = None  # all that is not black does not count


def masks_of(
    source: pathlib.Path, sources: Sequence[Source], masks: bool | str | pathlib.Path
) -> list[PictureMask] | None:
    """The masks of pictures, as `capture` takes them; None for whole pictures. source: the folder, or a video."""
    if masks is False:
        return None
    given = None if masks is True else checked_path(masks, "masks")
    if given is not None and not given.exists():
        raise MissingFileError(f"masks {str(given)!r} are not there: give a folder of masks, or one picture for all")
    if given is not None and not given.is_dir():
        if given.suffix.lower() not in ENDINGS:
            raise InputError(
                f"masks {str(given)!r} must be a folder of masks, or one picture for all{seen_note(given)}"
            )
        return [PictureMask(given)] * len(sources)
    if given is None and not source.is_dir():
        return None
    files = [each.file for each in sources]
    views = [View(file, np.eye(4), str(file), (1.0, 1.0, 0.0, 0.0)) for file in files]
    folder = files[0].parent if (files[0].parent / "masks").is_dir() else files[0].parent.parent
    views = with_masks(folder, views, True, (), home=given)
    found = [PictureMask(view.mask, view.ignored) for view in views]
    if given is not None and not any(each.opacity for each in found):
        raise InputError(
            f"no mask of {str(given)!r} has the name of a picture: {files[0].stem}.png or {files[0].name}.png would be "
            f"that of {files[0].name}"
        )
    return found


def write_feature_masks(
    folder: pathlib.Path, sources: Sequence[Source], masks: Sequence[PictureMask], small: Sequence[pathlib.Path]
) -> float | None:
    """Write what of the shrunk pictures counts, as COLMAP takes it: NAME.png for NAME, black where nothing does; those
    that are there stay. Returns the share of pixels that count, None where all of them do."""
    # COLMAP leaves out a picture without a mask, and does not scale one of another size
    if not any(mask.opacity or mask.ignored or each.has_opacity for mask, each in zip(masks, sources, strict=True)):
        return None
    folder.mkdir(exist_ok=True)

    def write(index: int) -> float:
        from PIL import Image

        file = folder / f"{small[index].name}.png"
        if not file.is_file():
            kept = counted_pixels(sources[index], masks[index])
            with Image.open(small[index]) as picture:
                size = picture.size
            kept = np.ones(size[::-1], bool) if kept is None else _shrunk(kept, size)
            with atomic_path(file) as temporary:
                Image.fromarray(np.where(kept, 255, 0).astype(np.uint8)).save(temporary, "PNG")
        with Image.open(file) as picture:
            return float((np.asarray(picture) > 0).mean())

    with ThreadPoolExecutor(cpu_threads()) as pool:
        share = float(np.mean(list(pool.map(write, range(len(sources))))))
    return None if share == 1.0 else share


def counted_pixels(source: Source, mask: PictureMask) -> np.ndarray | None:
    """(h, w) bool what of a picture counts, by its masks and its own opacity; None for all of it."""
    parts = [] if mask.opacity is None else [mask_opacity(source, mask.opacity) >= 0.5]
    if mask.ignored is not None:
        parts.append(ignored_pixels(source, mask.ignored) == 0.0)
    if source.has_opacity:
        parts.append(load_upright(source.file)[..., 3] >= 128)
    return np.logical_and.reduce(parts) if parts else None


def mask_opacity(source: Source, file: pathlib.Path) -> np.ndarray:
    """(h, w) float32 opacity of a picture, as it is looked at, by a mask; ValueError for one of another size."""
    image = _upright(source, file)
    return np.asarray(opacity_rows(lambda first, last: image[first:last])(0, None)[..., 0], np.float32)


def ignored_pixels(source: Source, file: pathlib.Path) -> np.ndarray:
    """(h, w) float32 how bright a mask of what does not count is; ValueError for one of another size."""
    image = _upright(source, file)
    return image[..., : 3 if image.shape[-1] > 2 else 1].max(axis=-1)  # of grey and opacity the grey


def _upright(source: Source, file: pathlib.Path) -> np.ndarray:
    """(h, w, c) in [0, 1] a mask, turned with its picture where it has the shape that this is stored in."""
    from PIL import Image

    image = read_image(file)
    if image.shape[1::-1] == source.size:
        return image
    if image.shape[:2] == source.size and is_on_its_side(source.file):
        with Image.open(source.file) as picture:
            return TURNS[picture.getexif()[ORIENTATION]](image)
    width, height = source.size
    raise InputError(
        f"mask {str(file)!r} is {image.shape[1]}x{image.shape[0]}, its picture {source.file.name!r} {width}x{height}: "
        "a mask has the size of its picture"
    )


def _shrunk(kept: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(h, w) bool pixels of a smaller picture that count: all that they are made of does, by more than half."""
    from PIL import Image

    whole = Image.fromarray(np.where(kept, 255, 0).astype(np.uint8))
    return np.asarray(whole.resize(size, Image.Resampling.BOX)) >= 128


def still_features(places: Sequence[np.ndarray], descriptors: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Which features of each picture, bool (k,), other pictures have too, at the same pixel: of what stands still.
    places: (k, 2) pixels; descriptors: (k, 128) of length 1; of each picture, all of one size."""
    # What turns comes back to a pixel in few pictures, however often it goes around; near its axis in neighbours.
    from scipy.spatial import KDTree

    count = len(places)
    trees = [KDTree(each.reshape(-1, 2)) for each in places]
    still = [np.zeros(len(each), bool) for each in places]

    def compare(index: int) -> None:
        rest = np.array([k for k in range(count) if k != index])
        chosen = rest[np.unique(np.linspace(0, len(rest) - 1, min(OTHERS, len(rest))).round().astype(int))]
        same = np.zeros(len(places[index]), np.int64)
        for other in chosen:
            near = trees[index].sparse_distance_matrix(trees[other], SAME_PLACE, output_type="coo_matrix")
            alike = np.einsum("ij,ij->i", descriptors[index][near.row], descriptors[other][near.col]) >= SAME_COSINE
            same[np.unique(near.row[alike])] += 1
        still[index] = same >= max(MIN_SAME, SAME_SHARE * len(chosen))

    run_parallel([functools.partial(compare, index) for index in range(count)])
    return still
