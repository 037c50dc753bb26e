"""Files of splats by their endings, read and written."""

from __future__ import annotations

import pathlib
from typing import Any

from ...core.checks import Cuts, checked_path, warn_caller
from ...core.files import PathLike, atomic_path, require_file
from ...errors import InputError
from .contents import LOGS, SplatContents, bounded_values, rounding_of, seen_logs, sound_contents
from .formats import BUILT_IN, SplatFormat, format_to_read, format_to_write, holding_format, require_own_beginning
from .sog import META

#: Endings of the files, and what writes them. The first that fits counts.
WRITERS = {each.endings[0]: each.write for each in BUILT_IN if each.write}

SPLAT_ENDINGS = tuple(WRITERS)


def splat_path(path: PathLike) -> pathlib.Path:
    """The file of a path: of a folder that holds splats the one that names the others, or the newest of 3D Gaussian
    Splatting."""
    file = checked_path(path, "the file of splats")
    if not file.is_dir():
        return file
    from ...scene.formats.datasets.splatting import iterations  # here, as most of a scene needs Warp's kernels

    return file / META if (file / META).is_file() else [file, *iterations(file).values()][-1]


def own_background(path: PathLike) -> dict[str, str]:
    """The background that splats in an output folder of 3D Gaussian Splatting were fitted with, as an option of the
    field; nothing for other files."""
    from ...scene.formats.datasets.splatting import output_of, trained_background  # as above

    folder = output_of(splat_path(path))
    color = None if folder is None else trained_background(folder)
    return {} if color is None else {"background": color}


def read_splats(path: PathLike, **options: Any) -> SplatContents:
    """Read a file of splats, or a folder of one; a .ply whose header says so is compressed.
    options: of `SplatField.load`, None for what was not given."""
    named = splat_path(path)
    format = format_to_read(named)
    given = _given(options, format.read_options, f"{format.name} files are not read", path)
    file = require_file(named, "splat file")
    assert format.read is not None
    require_own_beginning(file, format)
    return sound_contents(file, format.read(file, **given))


def write_splats(contents: SplatContents, path: PathLike, **options: Any) -> None:
    """Write a file of splats, whole or not at all; its ending says the format.
    options: of `SplatField.save`, None for what was not given."""
    format = format_to_write(path)
    given = _given(options, format.write_options, f"{format.name} files are not written", path)
    assert format.write is not None
    data, cuts = format.write(contents, **given), Cuts()
    values_of = bounded_values(contents) | {LOGS: seen_logs(contents)}
    for what, values in values_of.items():
        if what in format.ranges:
            cuts.clip(f"values of {what}", values, *format.ranges[what])
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    lines = [text for text in (cuts.text(".ply files keep it"), _rounding_text(contents, format)) if text]
    if lines:
        warn_caller(f"{path}: {'; '.join(lines)}")


def _rounding_text(contents: SplatContents, format: SplatFormat) -> str:
    """What a warning says where a format rounds positions by much beside the usual splat; "" elsewhere."""
    step = format.rounds(contents) if callable(format.rounds) else None
    rounded, size = rounding_of(contents, step) if format.rounds else (0.0, 0.0)
    if not rounded:
        return ""
    reason = "hold float32, which rounds positions so far from the origin" if step is None else "round these positions"
    return (
        f"{format.endings[0]} files {reason} to {rounded:.3g} units, and splats of {size:.3g} units with them: a .ply "
        "file keeps them"
    )


def is_splat_file(path: PathLike) -> bool:
    """Whether a file or folder holds splats, by its ending, and by its beginning where others have that ending too."""
    return holding_format(splat_path(path)) is not None


def _given(options: dict[str, Any], known: tuple[str, ...], what: str, path: PathLike) -> dict[str, Any]:
    """The options that were given; ValueError for one that a format does not have."""
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if name not in known:
            raise InputError(f"{path}: {what} with {name}: leave it out")
    return given
