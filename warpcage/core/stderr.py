"""What goes to stderr beside results: no notes of native code that tell nothing; a word while kernels compile."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator

#: What Warp's native code writes where there is no driver of NVIDIA's, as on every machine without a GPU.
NOTE = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver."

#: Names under which drivers are found.
_DRIVERS = ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1")

_done = threading.Event()


@contextlib.contextmanager
def without_driver_note() -> Iterator[None]:
    """Leave the line out of standard error that Warp writes as it starts without a CUDA driver; once in a process."""
    # Native code writes to the descriptor: that is led into a file for the moment, of which all other lines come back.
    if _done.is_set() or has_driver():
        yield
        return
    _done.set()
    try:
        kept, held = os.dup(2), tempfile.TemporaryFile()  # noqa: SIM115  (closed below)
    except OSError:  # no standard error, or nowhere to keep it
        yield
        return
    try:
        os.dup2(held.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        with held:
            held.seek(0)
            lines = b"".join(line for line in held if not line.startswith(NOTE))
        with contextlib.suppress(OSError):
            os.write(2, lines)


def has_driver() -> bool:
    """Whether there is a driver of NVIDIA's."""
    for name in _DRIVERS:
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


#: Called once, before the first module of kernels of this process is compiled. None says nothing.
say: Callable[[], object] | None = None


def told() -> None:
    """Say it, if nobody has."""
    global say
    saying, say = say, None
    if saying is not None:
        saying()
