"""Pictures that cameras are found of: upright, with what their cameras wrote into them; progress of the steps."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import threading
import warnings
from collections.abc import Sequence

import numpy as np

from ...core.checks import checked_path, listed, shown
from ...core.files import require_file
from ...core.names import agreed
from ...core.reports import Progress, Reporter, report_progress
from ...errors import InputError, MissingFileError
from ...scene.parsing import DYNAMIC_MASK
from ...view.pictures import MAX_PIXELS

#: Endings of pictures that are read, and of those that are not but are often there.
ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")

FOREIGN_ENDINGS = (".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")

#: Formats of these endings that Pillow is asked for. Phones write MPO too, which it opens as JPEG.
FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")

#: Tags of EXIF: turn of the camera, its own block, maker, model, focal lengths in millimetres and for 35 mm film.
ORIENTATION, EXIF_BLOCK, MAKER, MODEL, FOCAL, FOCAL_35 = 0x0112, 0x8769, 0x010F, 0x0110, 0x920A, 0xA405

#: The diagonal of a frame of 35 mm film, to which equivalent focal lengths refer, mm.
FILM_DIAGONAL = 43.267


@dataclasses.dataclass(frozen=True)
class Source:
    """A picture whose camera is looked for."""

    name: str  # its name in the scene, without ending; no two are the same
    file: pathlib.Path
    size: tuple[int, int]  # width and height as it is looked at, pixels
    focal: float | None  # focal length that its camera wrote, pixels of that size; None where it says nothing
    camera: tuple  # what pictures of one camera and zoom have in common
    lossless: bool  # its pixels were kept exactly, or it has opacity
    has_opacity: bool = False


def chosen_names(pictures: str | os.PathLike | Sequence[str]) -> list[str]:
    """Names of the pictures to use: themselves, or the lines of a text file."""
    if not isinstance(pictures, str | os.PathLike):
        if not isinstance(pictures, Sequence) or not all(isinstance(name, str) for name in pictures):
            raise InputError(f"pictures must be a text file or a list of names, got {shown(pictures)}")
        return list(pictures)
    path = checked_path(pictures, "pictures")
    require_file(path, "list of pictures")
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"list of pictures {str(path)!r} is not text: give names of pictures, one a line") from error
    return [line.strip() for line in lines if line.strip()]


def read_sources(folder: pathlib.Path, chosen: Sequence[str] | None = None) -> list[Source]:
    """What headers say of a folder's pictures, in the order of names; unreadable ones are left out, with a warning.
    chosen: names of those to use, with or without their endings; None is all."""
    entries = sorted(entry for entry in folder.iterdir() if entry.is_file() and not entry.name.startswith("."))
    files = [entry for entry in entries if entry.suffix.lower() in ENDINGS]
    files = [file for file in files if not file.name.startswith(DYNAMIC_MASK)]  # of what does not count in a picture
    if not files:
        raise MissingFileError(_no_pictures(folder, entries))
    if chosen is not None:
        known = {name for file in files for name in (file.name, file.stem)}
        missing = [name for name in chosen if name not in known]
        if missing:
            raise InputError(
                f"{str(folder)!r} holds no {agreed(len(missing), 'picture', 'pictures')} named {listed(missing, 4)}: "
                "the list of pictures names files of that folder, one a line"
            )
        files = [file for file in files if file.name in chosen or file.stem in chosen]
    sources, broken, names = [], [], set()
    for file in files:
        name = file.stem if file.stem not in names else file.name.replace(".", "_")
        try:
            source = _source(file, name)
        except Exception as error:  # whatever a library makes of a broken file
            broken.append((file.name, " ".join(str(error).split())))
            continue
        names.add(name)
        sources.append(source)
    if not sources:
        raise InputError(
            f"none of the {len(files)} pictures of {str(folder)!r} can be read: {broken[0][0]}: {broken[0][1]}"
        )
    if broken:
        warnings.warn(
            f"{len(broken)} of {len(files)} pictures of {str(folder)!r} cannot be read and "
            f"{agreed(len(broken), 'is', 'are')} left out: "
            f"{listed([name for name, _ in broken])}",
            stacklevel=3,
        )
    return sources


def load_upright(file: pathlib.Path) -> np.ndarray:
    """A picture as it is looked at, turned as its EXIF orientation says: (h, w, 3) uint8, or (h, w, 4) with opacity."""
    from PIL import Image, ImageOps

    require_file(file, "picture")
    try:
        with open(file, "rb") as stream, Image.open(stream, formats=FORMATS) as picture:
            upright = ImageOps.exif_transpose(picture)
            if upright.mode == "I;16":
                return np.repeat((np.asarray(upright) >> 8).astype(np.uint8)[..., None], 3, axis=-1)
            clear = "A" in upright.mode or "transparency" in upright.info
            return np.array(upright.convert("RGBA" if clear else "RGB"))
    except Exception as error:
        raise InputError(f"picture {str(file)!r} cannot be read: {' '.join(str(error).split())}") from error


def shrink_factor(size: tuple[int, int], most: int) -> float:
    """The factor, at most 1, by which a picture becomes at most `most` pixels long."""
    return min(1.0, most / max(size))


def _source(file: pathlib.Path, name: str) -> Source:
    """What the header of a picture says; raises where the file is cut off."""
    from PIL import Image

    require_file(file, "picture")
    with open(file, "rb") as stream, Image.open(stream, formats=FORMATS) as picture:
        width, height = picture.size
        if width * height > MAX_PIXELS:
            raise InputError(f"it declares {width}x{height} pixels, at most {MAX_PIXELS} are read")
        exif = picture.getexif()
        block = exif.get_ifd(EXIF_BLOCK)
        picture.load()
        has_opacity = "A" in picture.mode or "transparency" in picture.info
        lossless = has_opacity or str(picture.format) not in ("JPEG", "MPO", "WEBP")  # the first has no opacity
    size = (height, width) if exif.get(ORIENTATION, 1) in (5, 6, 7, 8) else (width, height)
    equivalent = _positive(block.get(FOCAL_35))
    focal = None if equivalent is None else equivalent * float(np.hypot(width, height)) / FILM_DIAGONAL
    made_by = tuple(str(exif.get(tag, "")).strip("\0 ") for tag in (MAKER, MODEL))
    camera = (size, *made_by, _positive(block.get(FOCAL)), equivalent)
    return Source(name, file, size, focal, camera, lossless, has_opacity)


def _positive(value: object) -> float | None:
    """A number above zero out of EXIF, or None."""
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0.0 < number < 1e5 else None


def _no_pictures(folder: pathlib.Path, entries: list[pathlib.Path]) -> str:
    foreign = sorted({entry.suffix.lower() for entry in entries if entry.suffix.lower() in FOREIGN_ENDINGS})
    if foreign:
        return (
            f"{str(folder)!r} holds pictures as {listed(foreign)} alone, which is not read: convert them to JPEG or PNG"
        )
    below = [entry.name for entry in sorted(folder.iterdir()) if entry.is_dir() and _has_pictures(entry)]
    hint = f": give one of its folders {listed(below)}" if below else f" ({', '.join(ENDINGS)})"
    return f"{str(folder)!r} holds no pictures{hint}"


def _has_pictures(folder: pathlib.Path) -> bool:
    try:
        return any(os.path.splitext(name)[1].lower() in ENDINGS for name in os.listdir(folder))
    except OSError:
        return False


class StepBar:
    """The progress of one step, as a context. total: None is not known; done: items that an earlier run did."""

    def __init__(self, total: int | None, step: str, progress: bool | Progress, *, done: int = 0):
        self._progress, self._total, self._step, self.done = progress, total or 0, step, done
        self._thread = threading.get_ident()

    def __enter__(self) -> StepBar:
        self.report()
        return self

    def __exit__(self, *error: object) -> None:
        if isinstance(self._progress, Reporter):
            self._progress.close()

    def update(self, count: int = 1) -> None:
        """Count items that are done."""
        self.done += count
        self.report()

    def report(self) -> None:
        """Report how far the step is, in the thread that began it: only there can the caller end the work."""
        if threading.get_ident() == self._thread:
            done = min(self.done, self._total) if self._total else self.done
            report_progress(self._progress, done, self._total, self._step)
