"""A fit whose batches are halved over two devices, whose gradients are summed by copies or by NCCL."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import warp as wp

import warpcage
from warpcage import FieldOptimizer
from warpcage.core import launch
from warpcage.fitting import sum_shards
from warpcage.kernels.fitting.rmsprop import add_gradients

#: Exchanges of gradients between two GPUs that are timed.
TIMED = 20


class SplitFit:
    """A fit whose batches are halved over two devices, or that of one device.

    Args:
        scene: The scene.
        devices: One or two.
        way: "warp" or "nccl", how gradients are summed.
        options: Of the fit.
    """

    def __init__(self, scene: warpcage.Scene, devices: list[str], way: str, **options):
        self.way, self.gradient_bytes = way, 0
        self.optimizers = [FieldOptimizer(scene, device=device, **options) for device in devices]
        if len(devices) == 1:
            return
        for optimizer in self.optimizers:
            batches = optimizer.batches
            rays = batches.batch_tiles // 2 * batches.rays.tile_size**2
            batches.squared_error = wp.zeros(rays, dtype=wp.float32, device=optimizer.device)
        if self.optimizers[0].device.is_cuda:
            for one, other in (self.optimizers, self.optimizers[::-1]):
                wp.set_peer_access_enabled(one.device, other.device, True)

    @property
    def done(self) -> bool:
        """Whether all steps are done."""
        return self.optimizers[0].schedule.is_done

    @property
    def same(self) -> bool:
        """Whether all devices hold the same field, to the bit."""
        densities = [optimizer.field.grid.density.numpy() for optimizer in self.optimizers]
        return all(np.array_equal(densities[0], other) for other in densities[1:])

    def step(self) -> None:
        """One step of FieldOptimizer, on all devices."""
        if len(self.optimizers) == 1:
            self.optimizers[0].step()
            return
        for rank, optimizer in enumerate(self.optimizers):
            schedule, batches = optimizer.schedule, optimizer.batches
            if schedule.refines:
                optimizer._refine()
            if schedule.thins_out:
                optimizer._thin_out()
            batches.advance(schedule.rays_per_side)
            batches.rays.first_tile += rank * (batches.batch_tiles // 2)
            optimizer.accumulate_gradients()
        self.exchange()
        for optimizer in self.optimizers:
            optimizer._apply_gradients()
            optimizer.schedule.step_count += 1

    def exchange(self) -> None:
        """Leave the sum of both gradients with both. It is twice that of a whole batch, which RMSProp does not see."""
        totals = [sum_shards(optimizer.current.gradients) for optimizer in self.optimizers]
        for optimizer in self.optimizers:
            optimizer.current.touched.fill_(1)
        self.gradient_bytes = totals[0].capacity
        (_sum_by_nccl if self.way == "nccl" else _sum_by_copies)(totals)

    def exchange_milliseconds(self) -> float:
        """Of one exchange of gradients, the median."""
        times = []
        for _ in range(TIMED):
            wp.synchronize()
            begin = time.perf_counter()
            self.exchange()
            wp.synchronize()
            times.append(1e3 * (time.perf_counter() - begin))
        return float(np.median(times))


def _sum_by_copies(totals: list[wp.array]) -> None:
    """Each device sums one half of the numbers and hands it to the other."""
    middle = totals[0].size // 2
    halves = [slice(0, middle), slice(middle, totals[0].size)]
    _wait_for_each_other(totals)
    for rank, half in enumerate(halves):
        theirs = wp.empty(half.stop - half.start, dtype=wp.float32, device=totals[rank].device)
        wp.copy(theirs, totals[1 - rank][half])
        launch(add_gradients, theirs.size, [theirs], [totals[rank][half]], device=theirs.device)
    _wait_for_each_other(totals)
    for rank, half in enumerate(halves):
        wp.copy(totals[1 - rank][half], totals[rank][half])
    _wait_for_each_other(totals)


def _wait_for_each_other(totals: list[wp.array]) -> None:
    """What each device is given from now on begins when both have done what they were given."""
    devices = [total.device for total in totals]
    if not devices[0].is_cuda:
        return
    events = [device.stream.record_event() for device in devices]
    for device, event in zip(devices, events[::-1], strict=True):
        device.stream.wait_event(event)


def _sum_by_nccl(totals: list[wp.array]) -> None:
    """One all-reduce, on the streams of Warp."""
    import torch

    tensors = [wp.to_torch(total) for total in totals]
    streams = [wp.stream_to_torch(total.device.stream) for total in totals]
    with contextlib.ExitStack() as stack:
        for stream in streams:
            stack.enter_context(torch.cuda.stream(stream))
        torch.cuda.nccl.all_reduce(tensors, streams=streams)
