"""`warpcage demo`, and `warpcage doctor`: what this machine has of what warpcage needs, and what to do where not."""

from __future__ import annotations

import argparse
import importlib
import pathlib
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from ...core.names import counted, error_line, extra_line
from .arguments import options


def run_demo(arguments: argparse.Namespace) -> None:
    """Run the example, from data to a posed picture, that the wheel holds."""
    argv = ["--out", arguments.output, *(["--device", arguments.device] if arguments.device else [])]
    importlib.import_module("warpcage.examples.render_lego").main(argv)


class Finding(NamedTuple):
    """One line: "ok", "note" where something is left out, "broken" where warpcage does not work."""

    state: str
    what: str
    text: str


#: Packages that only one step needs, and what is not done without them.
SPARED = {"pymeshlab": "cages cannot be generated"}

#: What encodes films, by their ending, and what decodes videos of phones.
ENCODERS = {".mp4": "libx264", ".mov": "prores_ks", ".webm": "libvpx-vp9"}
DECODERS = ("h264", "hevc")

#: Extras that users take, and what for. The others are for work on warpcage itself.
EXTRAS = {
    "edit": "the editor in the browser",
    "capture": "cameras of pictures and videos",
    "exr": "OpenEXR pictures",
    "heif": "HEIC pictures",
    "usd": "cages and meshes in USD",
    "texture": "meshes with textures",
    "cluster": "clusters of several machines",
    "completion": "completion of commands in the shell",
}

#: Memory and disk that scenes of usual size want to be free, bytes.
LITTLE_MEMORY, LITTLE_DISK = 4 << 30, 1 << 30

#: Largest errors of the picture and the points of the self-test.
PICTURE_ERROR, POINT_ERROR = 0.02, 1e-4


def run_doctor(args: argparse.Namespace) -> int:
    broken = 0
    for finding in _findings(args.device):
        broken += finding.state == "broken"
        print(f"{finding.state:6}  {finding.what:12}  {finding.text}", flush=True)
    print(f"{counted(broken, 'problem')} to fix" if broken else "warpcage works here")
    return 1 if broken else 0


def _findings(device: str | None) -> Iterator[Finding]:
    """All checks. What needs Warp is left out where packages, Warp or its cache are broken: it would say so again."""
    yield from _guarded("warpcage", _package)
    whole = True
    for what, check in (("packages", _packages), ("warp", _warp), ("kernel cache", _cache)):
        for finding in _guarded(what, check) if whole else ():
            whole &= finding.state != "broken"
            yield finding
    for what, check in (("memory", _memory), ("films", _codecs), ("extras", _extras)):
        yield from _guarded(what, check)
    if whole:
        yield from _guarded("self-test", lambda: _self_test(device))


def _guarded(what: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The findings of one check; what it raises is one too."""
    try:
        yield from check()
    except Exception as error:  # whatever it is, the other checks go on
        yield Finding("broken", what, error_line(error, named=True))


def _package() -> Iterator[Finding]:
    place = pathlib.Path(__file__).resolve().parents[1]
    yield Finding("ok", "warpcage", f"{options.package_version()} in {place}")
    yield Finding("ok", "python", f"{platform.python_version()}, {platform.platform()}")


def _is_installed() -> bool:
    """Whether there is a list of what warpcage needs: it is not only imported from a folder."""
    from importlib import metadata

    try:
        return bool(metadata.version("warpcage"))
    except metadata.PackageNotFoundError:
        return False


def _lacking(extra: str = "") -> list[tuple[str, str]]:
    """What the package or one of its extras asks for and is not here: as pip takes it, and the version that is here."""
    from importlib import metadata

    from packaging.requirements import Requirement

    lacking = []
    for need in map(Requirement, metadata.requires("warpcage") or ()):
        wanted = [need.marker is None or need.marker.evaluate({"extra": name}) for name in ("", extra)]
        if not wanted[1] or (extra and wanted[0]):
            continue
        try:
            found = metadata.version(need.name)
        except metadata.PackageNotFoundError:
            found = ""
        if not found or not need.specifier.contains(found, prereleases=True):
            lacking.append((f"{need.name}{need.specifier}", found))
    return lacking


def _packages() -> Iterator[Finding]:
    if not _is_installed():
        yield Finding("note", "packages", "warpcage is not installed, so its needs are not known: pip install -e .")
        return
    lacking = _lacking()
    if not lacking:
        yield Finding("ok", "packages", "all that warpcage needs, in versions that it works with")
    for need, found in lacking:
        name = re.split("[^A-Za-z0-9._-]", need)[0]
        text = f"{name} {found} is another version than warpcage needs" if found else f"{name} is not installed"
        spared = f", without which {SPARED[name]}" if name in SPARED else ""
        yield Finding("note" if spared else "broken", "packages", f"{text}{spared}: pip install '{need}'")


def _warp() -> Iterator[Finding]:
    import warp as wp

    from ...core.devices import resolve_device
    from ...core.reports import has_driver
    from .info import device_line

    resolve_device("cpu")
    yield Finding("ok", "warp", wp.__version__)
    for device in wp.get_devices():
        free = f", {device.free_memory / 2**30:.1f} GiB free" if device.is_cuda else ""
        yield Finding("ok", device.alias, device_line(device) + free)
    if wp.is_cuda_available():
        driver, built = (wp.get_cuda_driver_version() or ()), (wp.get_cuda_toolkit_version() or ())
        yield Finding("ok", "driver", f"for CUDA {_dotted(driver)}, Warp was built with {_dotted(built)}")
    elif has_driver():
        yield Finding("note", "driver", "there is one of NVIDIA's, but no GPU that Warp can use: see `nvidia-smi`")
    else:
        yield Finding("note", "driver", "none of NVIDIA's: all runs on the CPU; a GPU needs its driver installed")


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version)) or "unknown"


def _cache() -> Iterator[Finding]:
    import warp as wp

    folder = pathlib.Path(str(wp.config.kernel_cache_dir))
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
        free = shutil.disk_usage(folder).free
    except OSError as error:
        advice = "set WARP_CACHE_PATH to a folder that can"
        yield Finding("broken", "kernel cache", f"{folder} cannot be written to ({error.strerror}): {advice}")
        return
    if free < LITTLE_DISK:
        text = f"{folder} has {free / 2**20:.0f} MiB free: make room, or set WARP_CACHE_PATH to a folder with more"
        yield Finding("note", "kernel cache", text)
    else:
        yield Finding("ok", "kernel cache", f"{folder}, {free / 2**30:.0f} GiB free")


def _memory() -> Iterator[Finding]:
    from ...core.memory import UNKNOWN, free_host_bytes

    free = free_host_bytes()
    if free == UNKNOWN:
        yield Finding("note", "memory", "this system does not say how much is free")
    elif free < LITTLE_MEMORY:
        text = f"{free / 2**30:.1f} GiB free: close other programs, or take small pictures (--downscale, --max-memory)"
        yield Finding("note", "memory", text)
    else:
        yield Finding("ok", "memory", f"{free / 2**30:.1f} GiB free")


def _codecs() -> Iterator[Finding]:
    again = "pip install --force-reinstall av"
    try:
        import av
    except Exception as error:  # one of its libraries is not there, or another version
        yield Finding("broken", "films", f"PyAV cannot be loaded ({error_line(error, named=True)}): {again}")
        return
    for ending, name in ENCODERS.items():
        if name not in av.codecs_available:
            yield Finding("broken", "films", f"no encoder {name}, so no {ending} is written: {again}")
    for name in DECODERS:
        if name not in av.codecs_available:
            yield Finding("broken", "films", f"no decoder {name}, so videos of phones are not read: {again}")
    if {*ENCODERS.values(), *DECODERS} <= set(av.codecs_available):
        yield Finding("ok", "films", f"PyAV {av.__version__} writes {' '.join(ENCODERS)} and reads videos of phones")


def _extras() -> Iterator[Finding]:
    for extra, purpose in EXTRAS.items() if _is_installed() else ():
        lacking = " ".join(need for need, _ in _lacking(extra))
        if lacking:
            yield Finding("note", f"[{extra}]", f"{purpose}: needs {lacking}: {extra_line(extra)}")
        else:
            yield Finding("ok", f"[{extra}]", purpose)


def _self_test(name: str | None) -> Iterator[Finding]:
    """A picture of a cube, and points in a cage that is moved, against what is computed by formulas."""
    import numpy as np
    import warp as wp

    from ...cage.cage import Cage
    from ...coordinates.coordinates import deform_points
    from ...core.devices import resolve_device
    from ...field.voxel_field import VoxelField
    from ...view.camera import Camera

    started, device = time.perf_counter(), resolve_device(name)
    places = (np.indices((16, 16, 16)).transpose(1, 2, 3, 0) + 0.5) / 8.0 - 1.0
    density = np.where((np.abs(places) < 0.5).all(axis=-1), 2.0, 0.0)
    cube = VoxelField.from_dense(density, np.zeros((16, 16, 16, 9, 3)), [[-1] * 3, [1] * 3], device=device)
    opacity = cube.render(Camera.look_at((4, 0, 0), (0, 0, 0), width=9, height=9)).alpha[4, 4]
    picture_error = abs(float(opacity) - (1.0 - np.exp(-2.0)))  # one unit of it at a density of 2
    cage, points = Cage.box((-1, -1, -1), (1, 1, 1)), places[::5, ::5, ::5].reshape(-1, 3)
    affine = np.array([[1.5, 0.25, 0.0], [0.0, 0.75, 0.5], [-0.5, 0.0, 1.0]])
    moved = deform_points(points, cage, cage.with_vertices(cage.vertices @ affine + 1.0), "mean_value", device=device)
    point_error = float(np.abs(np.asarray(moved) - (points @ affine + 1.0)).max())
    if picture_error < PICTURE_ERROR and point_error < POINT_ERROR:  # neither holds where one is not a number
        seconds = time.perf_counter() - started
        yield Finding("ok", "self-test", f"a picture and a cage on {device.alias} in {seconds:.1f} s")
    else:
        errors = f"errors of {picture_error:.2g} in a picture and {point_error:.2g} in points on {device.alias}"
        advice = f"remove {wp.config.kernel_cache_dir}, update the driver, and report this if it stays"
        yield Finding("broken", "self-test", f"{errors}: {advice}")
