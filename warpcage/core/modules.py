"""Load modules of kernels: one thread at a time, and again where files of the kernel cache are damaged."""

from __future__ import annotations

import functools
import logging
import os
import pathlib
import shutil
import sys
import threading
import types
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import warp as wp

from ..errors import StateError
from ..kernels.core import variants
from ..package import IS_WHOLE
from . import reports
from .reports import Progress, without_driver_note
from .threads import cpu_threads, device_turn

#: What `wp.kernel` makes of a function: a wp.Kernel, which type checkers take for the function itself.
Kernel: TypeAlias = wp.Kernel | Callable[..., Any]

_log = logging.getLogger(__name__)

# Warp prints lines on stdout as it starts and for each module. They are off from here on, unless WARPCAGE_LOG=debug or
# a log level of Warp's own is set. Programs with a copy of this module set it themselves.
reports.start_log()
if IS_WHOLE and wp.config.log_level == wp.LOG_INFO and reports.requested_level() != "debug":
    wp.config.log_level = wp.LOG_WARNING


@functools.lru_cache(maxsize=1)
def _log_start() -> None:
    """Say once what Warp found."""
    _log.info("Warp %s, devices %s", wp.__version__, ", ".join(device.alias for device in wp.get_devices()))


#: Modules that are loaded, with their device and threads per block.
loaded_places: set[tuple[wp.Module, str, int | None]] = set()


def start_warp() -> None:
    """Start Warp, in one thread; costs nothing where it has started."""
    with variants.lock:
        try:
            with without_driver_note():
                wp.init()
                _log_start()
        except OSError as error:
            raise _unwritable(error) from error


def load_modules(
    modules: Iterable[types.ModuleType | Kernel], device: wp.DeviceLike, progress: bool | Progress = False
) -> None:
    """Compile and load kernel files, or the modules of kernels, side by side; each for the block size that it names."""
    device = wp.get_device(device)
    named = [each.module if isinstance(each, wp.Kernel) else wp.get_module(each.__name__) for each in modules]
    warp_modules = list(dict.fromkeys(named))  # two threads would compile one that is named twice
    with device_turn(device), variants.lock:  # Warp gives modules that two threads load at once the same name
        _cache_cpu_target()
        _report_new(warp_modules, device, progress=progress)
        try:
            wp.force_load(device, warp_modules, max_workers=min(len(warp_modules), cpu_threads()))
        except Exception:
            for module in warp_modules:  # the damaged ones anew
                _load(module, device, None if device.is_cpu else module.options["block_dim"])


def require_loaded(kernel: Kernel, device: wp.Device, block_dim: int) -> None:
    """Compile and load the module of a kernel, where that was not done, for so many threads per block on CUDA."""
    assert isinstance(kernel, wp.Kernel)
    place = (kernel.module, device.alias, None if device.is_cpu else block_dim)
    if place in loaded_places:
        return
    with device_turn(device), variants.lock:
        _cache_cpu_target()
        _report_new([kernel.module], device, block_dim)
        _load(kernel.module, device, place[2])
        loaded_places.add(place)


def _load(module: wp.Module, device: wp.Device, block_dim: int | None) -> None:
    """Load a module; where its files in the cache are damaged, remove them and compile it again."""
    try:
        wp.load_module(module, device=device, block_dim=block_dim)
    except OSError as error:
        raise _unwritable(error) from error
    except Exception as error:
        if module.failed_builds:  # it did not compile: the files are not to blame
            raise
        folder = _cache_folder(module, 1 if block_dim is None else block_dim)
        if _removed(folder):
            wp.load_module(module, device=device, block_dim=block_dim)
            return
        raise StateError(
            f"the compiled kernels in {folder} are damaged, and the folder cannot be removed: remove it, or set "
            "WARP_CACHE_PATH to another one"
        ) from error


def _report_new(
    modules: Sequence[wp.Module], device: wp.Device, block_dim: int | None = None, progress: bool | Progress = False
) -> None:
    """Report and log modules that are not in the cache, and are compiled next; block_dim: None is their own."""
    if reports.on_compiling is None and progress is False and not _log.isEnabledFor(logging.INFO):
        return
    threads = [1 if device.is_cpu else block_dim or module.options["block_dim"] for module in modules]
    new = [
        module.name for module, count in zip(modules, threads, strict=True) if not _cache_folder(module, count).exists()
    ]
    if new:
        reports.report_compiling()
        reports.report_progress(progress, 0, len(new), "compile kernels")
    _log.info(
        "%s on %s: %s",
        "compiles kernels" if new else "loads kernels",
        device,
        ", ".join(new or [each.name for each in modules]),
    )


def _unwritable(error: OSError) -> RuntimeError:
    return StateError(
        f"compiled kernels are kept in {wp.config.kernel_cache_dir}, which cannot be written to "
        f"({error.strerror}): set WARP_CACHE_PATH to a folder that can"
    )


def _cache_folder(module: wp.Module, block_dim: int) -> pathlib.Path:
    """The folder of a module in the kernel cache."""
    return pathlib.Path(str(wp.config.kernel_cache_dir), module.get_module_identifier(block_dim))


def _removed(folder: pathlib.Path) -> bool:
    """Take a folder away in one step, as other processes may look at it. Whether it is gone."""
    gone = folder.with_name(f"{folder.name}_damaged_p{os.getpid()}")
    try:
        os.replace(folder, gone)
    except OSError:
        return not folder.exists()  # another process was faster
    shutil.rmtree(gone, ignore_errors=True)
    return True


def _cache_cpu_target() -> None:
    """Get the compiler's version from Warp, which keeps it, before threads do."""
    # Its library writes the answer into one buffer at each call (Warp 1.19): two threads that load their first modules
    # at once may read it half written, and their objects get names that the next process does not find in the cache.
    get_version = getattr(sys.modules.get("warp._src.context"), "_get_cpu_toolchain_version", None)
    if get_version is not None:
        get_version()


if hasattr(os, "register_at_fork"):  # not on Windows; a thread that holds the lock is not in the forked process
    os.register_at_fork(after_in_child=lambda: setattr(variants, "lock", threading.RLock()))
