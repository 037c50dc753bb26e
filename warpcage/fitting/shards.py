"""Kernels whose items add to shared outputs, cut over CPU threads that each have outputs of their own."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Sequence

import warp as wp

from ..core.devices import launch, module_block_dim
from ..core.locks import device_turn
from ..core.modules import Kernel, require_loaded
from ..core.threads import cpu_threads, run_parallel
from ..kernels.fitting.rmsprop import add_gradients

#: Outputs of their own are worth their memory for up to this many CPU threads.
MAX_SHARDS = 8

#: Parts of a shard's work that one launch takes: an interrupt waits for it.
MOST_PARTS = 8192


def shard_count(device: wp.Device) -> int:
    """Shards of a fit on a device."""
    # CPU atomics are plain reads and writes, so threads must not share an output. A GPU needs one shard.
    return min(cpu_threads(), MAX_SHARDS) if device.is_cpu else 1


@dataclasses.dataclass(frozen=True)
class ShardedWork:
    """A kernel to launch in shards."""

    # its first parameter is `first`, the index of a shard's first item
    kernel: Kernel
    # parts of the work that stay together in one shard
    count: int
    # what the kernel takes after `first`, the same for all shards
    inputs: list
    # what it then takes, for each shard
    outputs: Sequence[Sequence]
    # items of the kernel per part
    items: int = 1


def launch_shards(works: Sequence[ShardedWork], shards: int, device: wp.Device) -> None:
    """Launch kernels one after another in each of several threads, which take one run of the parts of each work."""
    for work in works:  # before the threads, so that each module is compiled once
        require_loaded(work.kernel, device, module_block_dim(work.kernel))

    stopped = threading.Event()

    def run(shard: int) -> None:
        for work in works:
            first, last = (work.count * edge // shards for edge in (shard, shard + 1))
            most = MOST_PARTS if device.is_cpu else max(1, last - first)
            for part in range(first, last, most):
                if stopped.is_set():
                    return
                begin, end = (work.items * edge for edge in (part, min(part + most, last)))
                wp.launch(
                    work.kernel,
                    dim=end - begin,
                    inputs=[begin, *work.inputs],
                    outputs=list(work.outputs[shard]),
                    device=device,
                    block_dim=module_block_dim(work.kernel),
                )

    with device_turn(device):
        run_parallel([lambda shard=shard: run(shard) for shard in range(shards)], shards, stopped.set)


def sum_shards(gradients: Sequence[wp.array]) -> wp.array:
    """Move the gradients of all shards, (numbers,) float32 each, into the first, and return it."""
    total, *others = gradients
    for other in others:
        launch(add_gradients, total.size, [other], [total], device=total.device)
    return total
