"""Refuse work that a device has not the memory for, before it is begun."""

from __future__ import annotations

import os


def free_bytes(device) -> int:
    """Bytes that can still be allocated on a device; for the CPU what the system says, or all there is."""
    return free_host_bytes() if device.is_cpu else device.free_memory


def free_host_bytes() -> int:
    """Bytes of main memory that can still be allocated; where the system does not say, all there is."""
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return 1024 * int(line.split()[1])
    except OSError:
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not a POSIX system: nothing is known
        return 1 << 62


def require_memory(size: int, device, message: str, *, held: int = 0) -> None:
    """Raise ValueError unless `size` bytes are free on the device, or among the `held` ones that will be used again.

    `{size}` in the message becomes both figures.
    """
    free = free_bytes(device) + held
    if size > free:
        figures = f"{size / 2**30:.2f} GiB, {device.alias} has {free / 2**30:.2f} GiB free"
        raise ValueError(message.format(size=figures))
