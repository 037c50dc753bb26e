"""Files of splats by their endings, read and written."""

from __future__ import annotations

import pathlib

from ...core.checks import checked_path, warn_caller
from ...core.files import PathLike, atomic_path, require_file
from .compressed import is_compressed, read_compressed_ply, write_compressed_ply
from .contents import SplatContents, checked_contents, rounding_of
from .ply import read_parts, read_splat_ply, write_splat_ply
from .splat import read_splat, write_splat
from .spz import read_spz, write_spz

#: Endings of the files, and what writes them. The first that fits counts.
WRITERS = {".compressed.ply": write_compressed_ply, ".ply": write_splat_ply, ".splat": write_splat, ".spz": write_spz}

SPLAT_ENDINGS = tuple(WRITERS)


def splat_ending(path: PathLike) -> str:
    """The ending of a splat file, one of SPLAT_ENDINGS; ValueError for any other."""
    name = checked_path(path, "the file of splats").name.lower()
    for ending in SPLAT_ENDINGS:
        if name.endswith(ending):
            return ending
    raise ValueError(f"splat file {str(path)!r} must end in {', '.join(SPLAT_ENDINGS)}")


def read_splats(path: PathLike) -> SplatContents:
    """Read a file of splats; whether a .ply is a compressed one its header tells."""
    ending = splat_ending(path)
    file = require_file(path, "splat file")
    if ending == ".splat":
        contents = read_splat(file)
    elif ending == ".spz":
        contents = read_spz(file)
    else:
        parts = read_parts(file, ("chunk", "vertex", "sh"))
        contents = read_compressed_ply(file, parts) if is_compressed(parts) else read_splat_ply(file, parts)
    try:
        return checked_contents(contents)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def write_splats(contents: SplatContents, path: PathLike) -> None:
    """Write a file of splats, whole or not at all; its ending says the format."""
    ending = splat_ending(path)
    data = WRITERS[ending](contents)
    if ending in (".splat", ".compressed.ply"):
        rounded, size = rounding_of(contents)
        if rounded:  # .spz refuses what is so far away
            warn_caller(
                f"{path}: {ending} files hold float32, which rounds positions so far from the origin to {rounded:.3g} "
                f"units, and splats of {size:.3g} units with them: a .ply file keeps them"
            )
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def is_splat_file(path: PathLike) -> bool:
    """Whether a file holds splats, by its ending, and for .ply, which may be a mesh, by its header."""
    file = pathlib.Path(path)
    name = file.name.lower()
    if name.endswith((".splat", ".spz")):
        return True
    if not name.endswith(".ply") or not file.is_file():
        return name.endswith(".compressed.ply")
    with file.open("rb") as opened:
        head = opened.read(1 << 16).partition(b"end_header")[0]
    return b"packed_position" in head or (b"f_dc_0" in head and b"rot_0" in head)
