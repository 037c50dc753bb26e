"""PSNR on held-out views against seconds of fitting, and the work that the fit does per second.

    python benchmarks/fit_curve.py --data ../shared/data/lego_800 --device cuda:0 --json curve.json
    python benchmarks/fit_curve.py --data ../shared/data/lego_800 --downscale 8 --option footprint=0.7 epochs=16

The clock runs from the images in host memory to the finished field. Kernels are compiled beforehand; evaluations and
counts are left out. Samples are counted in separate passes, at each point of the curve and at both ends of a level,
over the training rays that see the object, and summed over the steps between: `marched` in cells that hold values,
`matter` those of them with density. A step takes them once for the colour and again for the gradient; they count once.

`peak_device_bytes` is the most that the arrays of the timed fit held at once, images included; each is counted when it
is made. The high-water mark of a memory pool cannot be reset, and would include the warm-up, earlier runs and the
renders between. A few MB of scratch that Warp takes for scans are left out.
"""

import argparse
import ast
import contextlib
import json
import platform
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.core.devices import launch, resolve_device
from warpcage.field.render import STOP_TRANSMITTANCE
from warpcage.fitting.evaluation import evaluate, mean_psnr
from warpcage.fitting.optimizer import FieldOptimizer
from warpcage.kernels.reference.sample_count import count_samples


def samples_per_ray(optimizer, *, wanted_rays: int = 1 << 20) -> np.ndarray:
    """(2,) samples marched and samples with density, per ray of a batch on average."""
    camera = optimizer.scene.cameras[0]
    total = len(optimizer.scene) * camera.width * camera.height
    stride = max(1, int((total / wanted_rays) ** 0.5))
    count = len(optimizer.scene) * -(-camera.width // stride) * -(-camera.height // stride)
    counts = [wp.empty(count, dtype=wp.int32, device=optimizer.device) for _ in range(2)]
    field = optimizer.field
    launch(
        count_samples,
        count,
        [field.grid, optimizer.rays.cameras, stride, field.step, STOP_TRANSMITTANCE],
        counts,
        device=optimizer.device,
    )
    active = optimizer.active_tiles / optimizer.tile_total  # batches leave the other tiles out, which march nothing
    return np.array([each.numpy().mean(dtype=np.float64) for each in counts]) / active


class CountedAllocator:
    """Wraps a device's allocator and counts what arrays hold from now on; `peak` grows while it is `watching`."""

    def __init__(self, device):
        self.inner = device.get_allocator()
        self.memory_kind = self.inner.memory_kind
        self.deallocate_requires_context_guard = self.inner.deallocate_requires_context_guard
        self.sizes, self.held, self.peak, self.watching = {}, 0, 0, True

    def allocate(self, size: int) -> int:
        pointer = self.inner.allocate(size)
        self.sizes[pointer] = size
        self.held += size
        if self.watching:
            self.peak = max(self.peak, self.held)
        return pointer

    def deallocate(self, pointer: int, size: int) -> None:
        self.held -= self.sizes.pop(pointer, 0)  # 0: made before the count began
        self.inner.deallocate(pointer, size)


@contextlib.contextmanager
def counted_allocations(device):
    """A CountedAllocator in place of a device's own."""
    counted = CountedAllocator(device)
    try:
        if device.is_cuda:
            wp.set_device_allocator(device, counted)
        else:  # Warp has no call for this
            device.default_allocator = counted
        yield counted
    finally:
        if device.is_cuda:
            wp.set_device_allocator(device, None)
        else:
            device.default_allocator = counted.inner


class Clock:
    """Seconds since it was made, without the pauses, and what allocations hold. The device is synchronised whenever
    it is read."""

    def __init__(self, device, allocations: CountedAllocator):
        self.device, self.allocations, self.seconds = device, allocations, 0.0
        self.go_on()

    def pause(self) -> float:
        wp.synchronize_device(self.device)
        self.seconds += time.perf_counter() - self.begin
        self.allocations.watching = False
        return self.seconds

    def go_on(self) -> None:
        self.allocations.watching = True
        self.begin = time.perf_counter()


def curve_point(optimizer, test, seconds: float, samples) -> dict:
    return {
        "seconds": round(seconds, 3),
        "steps": optimizer.step_count,
        "resolution": max(optimizer.field.resolution),
        "voxels": optimizer.field.voxel_count,
        "psnr": round(mean_psnr(evaluate(optimizer.field, test)), 3),
        "marched_per_ray": round(float(samples[0]), 2),
        "matter_per_ray": round(float(samples[1]), 2),
    }


def measure(scene, test, device, points: int, options: dict) -> dict:
    warm_up = FieldOptimizer(scene, device=device, **{**options, "epochs": 1e-3})
    while warm_up.step_count < warm_up.total_steps:
        warm_up.step()
    warm_up.finish()
    del warm_up
    with counted_allocations(device) as allocations:
        return measure_fit(scene, test, device, points, options, allocations)


def measure_fit(scene, test, device, points: int, options: dict, allocations: CountedAllocator) -> dict:
    clock = Clock(device, allocations)
    optimizer = FieldOptimizer(scene, device=device, **options)
    setup = clock.pause()
    curve = []
    marks = set(np.linspace(0, optimizer.total_steps, points + 1)[1:].astype(int).tolist())
    samples, counted_at = np.zeros(2), 0
    here = samples_per_ray(optimizer)
    clock.go_on()
    while optimizer.step_count < optimizer.total_steps:
        level = optimizer.level
        optimizer.step()
        count = optimizer.step_count
        if optimizer.level != level:  # the level's first step is done
            clock.pause()
            here = samples_per_ray(optimizer)
            clock.go_on()
        if count in marks or optimizer.level_done:
            seconds = clock.pause()
            before, here = here, samples_per_ray(optimizer)
            samples += 0.5 * (before + here) * (count - counted_at) * optimizer.batch_rays
            counted_at = count
            if count in marks:
                curve.append(curve_point(optimizer, test, seconds, here))
                print(curve[-1], flush=True)
            clock.go_on()
    field = optimizer.finish()
    spent = clock.pause()
    rows = evaluate(field, test)
    camera = test.cameras[0]
    times = []
    for _ in range(8):
        begin = time.perf_counter()
        field.render(camera)
        wp.synchronize_device(device)
        times.append(time.perf_counter() - begin)
    return {
        "options": options,
        "seconds": round(spent, 3),
        "setup_seconds": round(setup, 3),
        "psnr": mean_psnr(rows),
        "voxels": field.voxel_count,
        "resolution": field.resolution,
        "batch_rays": optimizer.batch_rays,
        "rays_per_second": round(optimizer.total_steps * optimizer.batch_rays / spent),
        "samples_marched_per_second": round(samples[0] / spent),
        "samples_matter_per_second": round(samples[1] / spent),
        "render_milliseconds": round(1e3 * float(np.median(times)), 3),
        "peak_device_bytes": allocations.peak,
        "image_bytes": optimizer.pictures.held_bytes,
        "image_bits": optimizer.pictures.bits,
        "curve": curve,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="scene folder with train and test splits")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--device", default=None)
    parser.add_argument("--points", type=int, default=6, help="points on the curve")
    parser.add_argument("--option", nargs="*", action="append", help="FitOptions as name=value; repeat for more runs")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = resolve_device(args.device)
    scene = warpcage.load_scene(args.data, downscale=args.downscale)
    test = warpcage.load_scene(args.data, split="test", downscale=args.downscale)
    results = []
    for run in args.option or [[]]:
        options = {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in run)}
        print(options, flush=True)
        results.append(measure(scene, test, device, args.points, options))
        print({name: value for name, value in results[-1].items() if name != "curve"}, flush=True)
        if args.json:
            content = {"device": device.name or platform.processor(), "warp": wp.__version__, "runs": results}
            with open(args.json, "w", encoding="utf-8") as file:
                json.dump(content, file, indent=1)


if __name__ == "__main__":
    main()
