"""Choose a Warp device, and launch kernels on all cores of the CPU."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import warp as wp

from .threads import cpu_threads, run_parallel

#: What `wp.kernel` makes of a function: a wp.Kernel, which type checkers take for the function itself.
Kernel = wp.Kernel | Callable[..., Any]


def resolve_device(device: wp.DeviceLike = None) -> wp.Device:
    """The Warp device of a name.

    Args:
        device: A Warp device or its name. None is the first CUDA device, or the CPU where there is none.

    Returns:
        The device.

    Raises:
        ValueError: If the machine has no such device.
    """
    if isinstance(device, wp.Device):
        return device
    wp.init()
    if device is None:
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    try:
        if str(device).startswith("cuda") and not wp.is_cuda_available():
            raise ValueError("no CUDA")  # Warp would look for its current context, and print that there is no driver
        return wp.get_device(str(device))
    except Exception as error:
        present = ", ".join(found.alias for found in wp.get_devices())
        raise ValueError(f"device {str(device)!r} is not there: this machine has {present}") from error


def launch(
    kernel: Kernel,
    count: int,
    inputs: Sequence[Any],
    outputs: Iterable[Any] = (),
    *,
    device: wp.DeviceLike,
    threads: int | None = None,
    block_dim: int | None = None,
) -> None:
    """Launch a one-dimensional kernel whose first parameter is `first`, the index of this launch's first item.

    On CUDA it is one launch with `first` = 0. On the CPU the items are cut into chunks that run on several threads, so
    outputs of different items must be disjoint: no atomics across items there.

    Args:
        kernel: The kernel.
        count: Number of items. Nothing is launched for 0.
        inputs: Arguments of the kernel after `first`.
        outputs: Arguments of the kernel after those.
        device: Warp device that holds them.
        threads: Threads on the CPU. None is `cpu_threads()`.
        block_dim: Threads per block on CUDA. None is what the kernel's module names, as a module is compiled once more
            for each other number.
    """
    assert isinstance(kernel, wp.Kernel)
    device = wp.get_device(device)
    if count <= 0:
        return
    threads = cpu_threads() if threads is None else threads
    block_dim = module_block_dim(kernel) if block_dim is None else block_dim
    if not device.is_cpu or threads <= 1 or count < 2 * threads:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=list(outputs), device=device, block_dim=block_dim)
        return

    wp.load_module(kernel.module, device=device)  # before the threads, so that it is compiled once
    chunk_count = min(8 * threads, count)
    edges = [count * i // chunk_count for i in range(chunk_count + 1)]

    def run(begin: int, end: int) -> None:
        wp.launch(kernel, dim=end - begin, inputs=[begin, *inputs], outputs=list(outputs), device=device)

    run_parallel([lambda b=b, e=e: run(b, e) for b, e in zip(edges, edges[1:], strict=False)], threads)


def lane_count(device: wp.DeviceLike) -> int:
    """Items that share a piece of work in kernels written for a group of lanes (kernels/core/lanes.py).

    Args:
        device: Warp device.

    Returns:
        1 on the CPU, else 32.
    """
    return 1 if wp.get_device(device).is_cpu else 32


def module_block_dim(kernel: Kernel) -> int:
    """Threads per block that a kernel's module is meant for.

    Args:
        kernel: The kernel.

    Returns:
        The option block_dim of its module, 256 where it names none.
    """
    assert isinstance(kernel, wp.Kernel)
    return kernel.module.options["block_dim"]


def load_modules(modules: Iterable[types.ModuleType], device: wp.DeviceLike) -> None:
    """Compile and load modules of kernels side by side, each for the block size that it names.

    Launched one by one they would wait for each other. Costs nothing where they are loaded.

    Args:
        modules: Python modules that hold kernels.
        device: Warp device.
    """
    warp_modules = [wp.get_module(module.__name__) for module in modules]
    _ask_cpu_target()
    wp.force_load(device, warp_modules, max_workers=min(len(warp_modules), cpu_threads()))


def _ask_cpu_target() -> None:
    """Ask Warp for the compiler's version, which it keeps, before threads do.

    Its library writes the answer into one buffer at each call (Warp 1.19): two threads that load their first modules at
    once may read it half written, and their objects get names that the next process does not find in the cache.
    """
    ask = getattr(sys.modules.get("warp._src.context"), "_get_cpu_toolchain_version", None)
    if ask is not None:
        ask()
