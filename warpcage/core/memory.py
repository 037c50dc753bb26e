"""Refuse work that needs more memory than a device has, before it begins."""

from __future__ import annotations

import os

import warp as wp


def free_bytes(device: wp.Device) -> int:
    """Memory that can still be allocated on a device.

    Args:
        device: The device.

    Returns:
        Bytes; for the CPU as `free_host_bytes`.
    """
    return free_host_bytes() if device.is_cpu else device.free_memory


def free_host_bytes() -> int:
    """Main memory that can still be allocated.

    Returns:
        Bytes: what is available, or else all there is, or a number beyond any memory where the system tells neither.
    """
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


def require_memory(size: int, device: wp.Device, message: str, *, held: int = 0) -> None:
    """Refuse work that needs more memory than is free.

    Args:
        size: Bytes that the work needs.
        device: The device that it runs on.
        message: The error's text; `{size}` in it becomes what is needed and what is free.
        held: Bytes that are allocated now and will be used again.

    Raises:
        ValueError: If fewer bytes are free.
    """
    free = free_bytes(device) + held
    if size > free:
        figures = f"{size / 2**30:.2f} GiB, {device.alias} has {free / 2**30:.2f} GiB free"
        raise ValueError(message.format(size=figures))
