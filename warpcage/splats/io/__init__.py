"""Files of splats by their endings, read and written."""

from __future__ import annotations

import pathlib
from typing import Any

from ...core.checks import checked_path, warn_caller
from ...core.files import PathLike, atomic_path, require_file
from ...errors import InputError
from .contents import SplatContents, rounding_of, sound_contents
from .formats import BUILT_IN, format_to_read, format_to_write, holding_format, require_own_beginning
from .sog import META

#: Endings of the files, and what writes them. The first that fits counts.
WRITERS = {each.endings[0]: each.write for each in BUILT_IN if each.write}

SPLAT_ENDINGS = tuple(WRITERS)


def splat_path(path: PathLike) -> pathlib.Path:
    """The file of a path: of a folder that holds splats the one that tells of the others."""
    file = checked_path(path, "the file of splats")
    return file / META if file.is_dir() and (file / META).is_file() else file


def read_splats(path: PathLike, **options: Any) -> SplatContents:
    """Read a file of splats, or a folder of one; whether a .ply is a compressed one its header tells.
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
    data = format.write(contents, **given)
    if format.rounds:
        rounded, size = rounding_of(contents)
        if rounded:  # .spz refuses what is so far away
            warn_caller(
                f"{path}: {format.endings[0]} files hold float32, which rounds positions so far from the origin to "
                f"{rounded:.3g} units, and splats of {size:.3g} units with them: a .ply file keeps them"
            )
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


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
