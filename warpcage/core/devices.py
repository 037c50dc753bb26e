"""Choose a Warp device, and launch kernels on all cores of the CPU."""

from __future__ import annotations

import warp as wp

from .threads import CPU_THREADS, run_parallel


def resolve_device(device=None) -> wp.Device:
    """The Warp device named `device`; None is the first CUDA device, or the CPU where there is none.

    Raises ValueError when the named device is not there.
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
    kernel: wp.Kernel,
    count: int,
    inputs,
    outputs=(),
    *,
    device,
    threads: int | None = None,
    block_dim: int | None = None,
) -> None:
    """Launch a one-dimensional kernel whose first parameter is `first`, the index of this launch's first item.

    On CUDA it is one launch with `first` = 0, in blocks of `block_dim` (default: what the kernel's module says, as a
    module is compiled anew for each other number). On the CPU the items are cut into chunks that run on `threads`
    threads (default CPU_THREADS), so outputs of different items must be disjoint: no atomics across items there.
    """
    device = wp.get_device(device)
    if count <= 0:
        return
    threads = CPU_THREADS if threads is None else threads
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


def lane_count(device) -> int:
    """Items that share a piece of work in kernels written for a group of lanes (kernels/core/lanes.py)."""
    return 1 if wp.get_device(device).is_cpu else 32


def module_block_dim(kernel: wp.Kernel) -> int:
    """Threads a block that a kernel's module is meant for: its option block_dim, 256 where it names none."""
    return kernel.module.options["block_dim"]


def load_modules(modules, device) -> None:
    """Compile and load modules of kernels (Python modules) side by side, each for the block size that it names;
    launched one by one they would wait for each other. Costs nothing where they are loaded."""
    warp_modules = [wp.get_module(module.__name__) for module in modules]
    wp.force_load(device, warp_modules, max_workers=min(len(warp_modules), CPU_THREADS))
