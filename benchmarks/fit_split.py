"""One fit over two GPUs: each takes half of the rays of a batch, their gradients are summed, both take the same step.

    python benchmarks/fit_split.py --data ../shared/data/lego_800 --quality standard high --json fit_split.json
    python benchmarks/fit_split.py --data SCENE --devices cpu cpu --option resolution=32 --ways warp

Gradients go from GPU to GPU by copies of Warp (each sums half of the numbers, then hands the sums over) or by NCCL
(`torch.cuda.nccl.all_reduce`), where torch is there. Both devices hold the whole field and the same numbers to the bit,
as a + b is b + a. Beside seconds and PSNR stand the milliseconds that an exchange takes, alone and with nothing to wait
for, at the last level: what a step would have to save before two GPUs pay.
"""

from __future__ import annotations

import argparse
import ast
import time

import numpy as np
import warp as wp
from results import write_results

import warpcage
from warpcage.core.devices import launch
from warpcage.fitting.batches import sum_shards
from warpcage.fitting.evaluation import evaluate, mean_psnr
from warpcage.fitting.optimizer import FieldOptimizer
from warpcage.kernels.fitting.rmsprop import add_gradients

#: Exchanges that are timed.
TIMED = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="scene folder with train and test splits")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--quality", nargs="+", default=["standard"], choices=["fast", "standard", "high"])
    parser.add_argument("--devices", nargs=2, default=["cuda:0", "cuda:1"])
    parser.add_argument("--ways", nargs="+", default=["warp", "nccl"], choices=["warp", "nccl"])
    parser.add_argument("--option", nargs="*", default=[], help="FitOptions as name=value")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    wp.config.quiet = True
    options = {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in args.option)}
    scene = warpcage.load_scene(args.data, downscale=args.downscale)
    views = warpcage.load_scene(args.data, split="test", downscale=args.downscale)
    for device in args.devices:  # compiles the kernels
        FieldOptimizer(scene, device=device, **{"quality": "fast", **options}).step()
    rows = []
    for quality in args.quality:
        for way in ["", *args.ways]:
            devices = args.devices if way else args.devices[:1]
            begin = time.perf_counter()
            fit = SplitFit(scene, devices, way, quality=quality, **options)
            while not fit.done:
                fit.step()
            wp.synchronize()
            seconds = time.perf_counter() - begin
            same = fit.same
            exchange = fit.exchange_milliseconds() if way else 0.0
            field = fit.optimizers[0].finish()
            row = {
                "quality": quality,
                "way": way or "one device",
                "seconds": seconds,
                "psnr": mean_psnr(evaluate(field, views)),
                "exchange_ms": exchange,
                "gradient_megabytes": fit.gradient_bytes / 1e6,
                "steps": fit.optimizers[0].step_count,
                "same": same,
            }
            print(row, flush=True)
            rows.append(row)
            del fit, field
    if args.json:
        write_results(args.json, args.devices[0], rows=rows)


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
            optimizer._accumulate_gradients()
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
    import contextlib

    import torch

    tensors = [wp.to_torch(total) for total in totals]
    streams = [wp.stream_to_torch(total.device.stream) for total in totals]
    with contextlib.ExitStack() as stack:
        for stream in streams:
            stack.enter_context(torch.cuda.stream(stream))
        torch.cuda.nccl.all_reduce(tensors, streams=streams)


if __name__ == "__main__":
    main()
