"""The formats of files of splats in one table: how each is called and recognized, read and written."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterator, Mapping
from typing import cast

from ...core.checks import checked_path, registered_formats, require_endings, require_type
from ...core.files import PathLike
from ...errors import InputError
from . import compressed, gltf, sog, spz, usd, web_viewers
from .compressed import is_compressed, read_compressed_ply, write_compressed_ply
from .contents import SplatContents
from .gltf import has_splats, read_gltf_splats, write_glb_splats
from .ply import read_parts, read_splat_ply, write_splat_ply
from .sog import META, has_sog_meta, read_sog, write_sog
from .spz import read_spz, write_spz
from .usd import USD_ENDINGS, has_usd_splats, read_usd_splats, write_usd_splats
from .web_viewers import read_ksplat, read_splat, write_splat

#: Where other packages register a SplatFormat, in the entry points of their setup.
ENTRY_POINTS = "warpcage.splat_formats"


@dataclasses.dataclass(frozen=True)
class SplatFormat:
    """A format of files of splats, as another package registers it too: see docs/splats.md."""

    name: str  # what it is called, such as "Niantic SPZ"
    endings: tuple[str, ...]  # of its files, such as (".spz",), in small letters
    read: Callable[..., SplatContents] | None = None  # from the path of a file; None where it is only written
    write: Callable[..., bytes] | None = None  # from values to the bytes of a file; None where it is only read
    # whether a file of those endings, which may not be there, holds splats; None where no others have the ending
    recognize: Callable[[pathlib.Path], bool] | None = None
    read_options: tuple[str, ...] = ()  # names of options of `SplatField.load` that `read` takes
    write_options: tuple[str, ...] = ()  # names of options of `SplatField.save` that `write` takes
    # whether `write` keeps positions as float32, or what gives their step, world units; it is said where that is much
    rounds: bool | Callable[[SplatContents], float] = False
    # the least and largest numbers that its files hold, and the step between two, by what they are (`bounded_values`)
    ranges: Mapping[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict, compare=False)

    def has_ending(self, path: PathLike) -> bool:
        """Whether a path ends as files of the format do."""
        return pathlib.Path(path).name.lower().endswith(self.endings)

    def holds(self, path: PathLike) -> bool:
        """Whether a file is one of the format, by its ending and, where that is ambiguous, by its beginning."""
        return self.has_ending(path) and (self.recognize is None or self.recognize(pathlib.Path(path)))


def read_ply(path: pathlib.Path, activated: bool | None = None) -> SplatContents:
    """The splats of a .ply file; one whose header says so is compressed."""
    parts = read_parts(path, ("chunk", "vertex", "sh"))
    if not is_compressed(parts):
        return read_splat_ply(path, parts, activated)
    if activated is not None:
        raise InputError(f"{path}: activated is for plain .ply files: what packed ones hold is known")
    return read_compressed_ply(path, parts)


def _is_splat_ply(path: pathlib.Path) -> bool:
    """Whether a .ply file, which may be a mesh, holds splats, by its header."""
    if not path.is_file():
        return path.name.lower().endswith(".compressed.ply")
    with path.open("rb") as opened:
        head = opened.read(1 << 16).partition(b"end_header")[0]
    return b"packed_position" in head or (b"f_dc_0" in head and b"rot_0" in head)


#: Endings that no format of splats has: others are not looked for.
_OTHERS = ("", ".npz", ".json", ".ply", ".png")

_GLTF = "glTF with KHR_gaussian_splatting"

#: All that warpcage knows by itself. The first whose ending fits counts.
BUILT_IN = (
    SplatFormat(
        "SuperSplat compressed PLY",
        (".compressed.ply",),
        read_ply,
        write_compressed_ply,
        _is_splat_ply,
        ranges=compressed.RANGES,
        rounds=compressed.position_step,
    ),
    SplatFormat("3DGS PLY", (".ply",), read_ply, write_splat_ply, _is_splat_ply, ("activated",)),
    SplatFormat("splat of web viewers", (".splat",), read_splat, write_splat, ranges=web_viewers.RANGES, rounds=True),
    SplatFormat("Niantic SPZ", (".spz",), read_spz, write_spz, None, (), ("version",), spz.position_step, spz.RANGES),
    SplatFormat("GaussianSplats3D ksplat", (".ksplat",), read_ksplat, ranges=web_viewers.KSPLAT_RANGES),
    SplatFormat("PlayCanvas SOG", (".sog",), read_sog, write_sog, rounds=sog.position_step),
    SplatFormat("PlayCanvas SOG in a folder", (META,), read_sog, None, has_sog_meta),
    SplatFormat(_GLTF, (".glb",), read_gltf_splats, write_glb_splats, has_splats, ranges=gltf.RANGES, rounds=True),
    SplatFormat(_GLTF, (".gltf",), read_gltf_splats, None, has_splats),
    *(
        SplatFormat(
            "USD with ParticleField3DGaussianSplat",
            (ending,),
            read_usd_splats,
            functools.partial(write_usd_splats, ending=ending),
            has_usd_splats,
            ranges=usd.RANGES,
        )
        for ending in USD_ENDINGS
    ),
)


def splat_formats() -> tuple[SplatFormat, ...]:
    """All formats: warpcage's own, then those that other packages registered."""
    return (*BUILT_IN, *other_formats())


@functools.cache
def other_formats() -> tuple[SplatFormat, ...]:
    """The formats of other packages; an ending belongs to the first format that has it."""
    return tuple(registered_formats(ENTRY_POINTS, "the splat format", _require_format))


def _require_format(format: object) -> None:
    require_type(format, SplatFormat, "it must be")
    require_endings(cast(SplatFormat, format).endings)


def _candidates(path: PathLike) -> Iterator[SplatFormat]:
    """The formats that a file may have; those of other packages last, as to look for them takes a while."""
    yield from BUILT_IN
    if pathlib.Path(path).suffix.lower() not in _OTHERS:
        yield from other_formats()


def endings_read() -> tuple[str, ...]:
    """The endings of files that are read, for messages: short ones first."""
    return tuple(sorted({ending: 0 for each in splat_formats() if each.read for ending in each.endings}, key=len))


def endings_written() -> tuple[str, ...]:
    """The endings of files that are written, for messages: short ones first."""
    return tuple(sorted({ending: 0 for each in splat_formats() if each.write for ending in each.endings}, key=len))


def format_to_read(path: PathLike) -> SplatFormat:
    """The format of a file, by its ending; ValueError for one that is not known."""
    return _format_by_ending(path, lambda each: each.read, lambda: ", ".join(endings_read()))


def format_to_write(path: PathLike) -> SplatFormat:
    """The format that a file is written in, by its ending; ValueError for one that is not known."""
    return _format_by_ending(path, lambda each: each.write, lambda: f"{', '.join(endings_written())} to be written")


def _format_by_ending(path: PathLike, way: Callable[[SplatFormat], object], known: Callable[[], str]) -> SplatFormat:
    """The first format with the ending of a file that has a way; known: what it must end in, for people."""
    named = checked_path(path, "the file of splats")
    for each in _candidates(named):
        if way(each) and each.has_ending(named):
            return each
    raise InputError(f"splat file {str(path)!r} must end in {known()}")


#: What files of some formats begin with, and their endings.
_BEGINNINGS = {
    b"ply": (".ply",),
    b"NGSP": (".spz",),
    b"\x1f\x8b": (".spz",),
    b"PK\x03\x04": (".sog", ".usdz"),
    b"glTF": (".glb",),
    b"#usd": (".usda", ".usd"),
    b"PXR-": (".usdc", ".usd"),
}


def require_own_beginning(path: pathlib.Path, format: SplatFormat) -> None:
    """Refuse a file that begins as those of another format do, whatever its ending says."""
    with path.open("rb") as opened:
        head = opened.read(4)
    meant = next((endings for mark, endings in _BEGINNINGS.items() if head.startswith(mark)), None)
    if format in BUILT_IN and meant is not None and not any(each.endswith(meant) for each in format.endings):
        raise InputError(f"{path} begins as {meant[0]} files do, not as {format.endings[0]} files: give it that ending")


def holding_format(path: PathLike) -> SplatFormat | None:
    """The format of a file that holds splats; None for any other."""
    return next((each for each in _candidates(path) if each.read and each.holds(path)), None)
