"""Pictures made small, for features, sharpness and thumbnails."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..core.files import atomic_path
from ..core.threads import cpu_threads
from .progress import bar
from .sharpness import COMPARED_SIZE, sharpness, shrunk_grey
from .sources import Source, load_upright, shrink_factor


def shrink_all(
    sources: Sequence[Source], folder: pathlib.Path, size: int, progress: bool
) -> tuple[list[str], np.ndarray]:
    """Write pictures, but those that are there, with longer sides of at most `size` pixels, at which features are
    looked for. Returns their file names, and (n,) how sharp each is."""
    folder.mkdir(exist_ok=True)
    names = [
        f"{source.name.replace(' ', '_')}.png" for source in sources
    ]  # COLMAP's lists of pairs end names at spaces
    if len(set(names)) < len(names):
        names = [f"{index:05d}.png" for index in range(len(sources))]
    sharp = np.zeros(len(sources))

    def shrink(index: int) -> None:
        sharp[index] = _shrink(sources[index], folder / names[index], size)
        shown.update()

    with bar(len(sources), "shrink", progress) as shown, ThreadPoolExecutor(cpu_threads()) as pool:
        list(pool.map(shrink, range(len(sources))))
    return names, sharp


def _shrink(source: Source, file: pathlib.Path, size: int) -> float:
    """Write a picture no larger than `size`, unless it is there, and measure how sharp it is."""
    from PIL import Image

    if file.is_file():
        small = Image.open(file)
    else:
        picture = Image.fromarray(load_upright(source.file)).convert("RGB")
        factor = shrink_factor(source.size, size)
        goal = (max(1, int(picture.width * factor)), max(1, int(picture.height * factor)))
        part = (0.0, 0.0, min(goal[0] / factor, picture.width), min(goal[1] / factor, picture.height))
        # the same factor along both sides, so that pixels stay square: a lens with one focal length needs it
        small = picture if factor == 1.0 else picture.resize(goal, Image.Resampling.LANCZOS, part, reducing_gap=2.0)
        with atomic_path(file) as temporary:
            small.save(temporary, compress_level=1)
    return sharpness(shrunk_grey(np.asarray(small.convert("L")), COMPARED_SIZE))
