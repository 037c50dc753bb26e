"""Locks of what threads share: objects that own buffers, and devices whose streams belong to the whole process."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import warp as wp

#: What `threading.RLock()` makes: a lock that the thread that holds it may take again.
Lock: TypeAlias = "contextlib.AbstractContextManager[bool]"

_Method = TypeVar("_Method", bound=Callable[..., Any])

_NO_LOCK: contextlib.AbstractContextManager[None] = contextlib.nullcontext()

_device_locks: dict[int, Lock] = {}


def device_turn(device: wp.Device) -> contextlib.AbstractContextManager[object]:
    """What to hold (`with`) while work for a device is handed over: one lock in the process for each CUDA device."""
    # Warp's current stream and list of captures belong to a CUDA device: another thread's launch would land in this
    # one's graph, or on a side stream that nothing waits for. Launched work needs no lock. CPU launches share no state.
    return _NO_LOCK if device.is_cpu else _device_lock(device)


def owner_lock(device: wp.Device) -> Lock:
    """The lock of an object that owns buffers on a device: its own on the CPU, `device_turn` on CUDA."""
    # On the CPU threads with an object each do not wait; on CUDA two locks could make two threads wait for ever.
    return threading.RLock() if device.is_cpu else _device_lock(device)


def in_turn(method: _Method) -> _Method:
    """Let a method of an object with a `device` hold `device_turn` of it."""

    @functools.wraps(method)
    def turn(self: Any, *args: Any, **options: Any) -> Any:
        with device_turn(self.device):
            return method(self, *args, **options)

    return turn  # pyright: ignore[reportReturnType]


def _device_lock(device: wp.Device) -> Lock:
    return _device_locks.setdefault(device.ordinal, threading.RLock())


if hasattr(os, "register_at_fork"):  # another thread of the parent may have held them, and is not in the child
    os.register_at_fork(after_in_child=_device_locks.clear)
