"""Views of Gaussian splats: time, and agreement with gsplat.

    python benchmarks/splats.py --device cpu
    python benchmarks/splats.py --device cuda:0 --peer FOLDER --json docs/results/splats_times_cuda.json

Scenes: 300,000 splats of degree 3 on balls, which fill a picture of 800x800; and the real files of the folder that
WARPCAGE_DATA names, if any. On the CPU what counts is the processor time of all threads, as other programs may run.
--peer names the unpacked wheel of gsplat (splats_peer.py), which needs nvcc and torch: its pictures are compared, and
both are timed by turns.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import statistics
import time

import numpy as np
import warp as wp
from results import write_results
from splats_peer import build_peer, peer_view

import warpcage
from warpcage.core.devices import resolve_device

WHITE = (1.0, 1.0, 1.0)


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = resolve_device(args.device)
    peer = build_peer(args.peer) if args.peer else None
    rows = []
    for name, field in scenes(args, device):
        for size in args.sizes:
            for antialias in (False, True) if peer else (False,):
                camera = view_of(field, size)
                row = {"scene": name, "splats": len(field), "degree": field.degree, "size": size}
                row |= {"antialias": antialias} | measure(field, camera, antialias, peer, args.runs)
                rows.append(row)
                print(row, flush=True)
                if args.json:
                    write_results(args.json, device, rows=rows)


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--count", type=int, default=300_000, help="splats of the synthetic scene")
    parser.add_argument("--sizes", type=int, nargs="*", default=None, help="pixels along each side; default: 400 800")
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--peer", help="folder of gsplat's unpacked wheel")
    parser.add_argument("--json")
    args = parser.parse_args()
    args.sizes = args.sizes or [400, 800]
    return args


def scenes(args, device):
    yield "balls", ball_scene(args.count, device)
    folder = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data")) / "splats"
    for path in sorted(folder.glob("*.ply")):
        yield path.name, warpcage.SplatField.load(path, device=device)


def ball_scene(count: int, device) -> warpcage.SplatField:
    """Splats on twelve balls: sizes, shapes and opacities spread as those of fitted scenes are."""
    rng = np.random.default_rng(0)
    ball, middles, radii = rng.integers(0, 12, count), rng.uniform(-0.7, 0.7, (12, 3)), rng.uniform(0.2, 0.5, 12)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return warpcage.SplatField(
        middles[ball] + radii[ball, None] * normals,
        np.log(0.006) + 0.7 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        2.0 * rng.normal(size=count) - 0.5,
        0.15 * rng.normal(size=(count, 16, 3)),
        device=device,
    )


def view_of(field: warpcage.SplatField, size: int) -> warpcage.Camera:
    """A view that the splats fill."""
    places = field.contents.centres.astype(np.float64)
    low, high = np.percentile(places, [2, 98], axis=0)
    middle, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    eye = middle + 1.7 * radius * np.array([0.5, 0.3, -0.81])
    return warpcage.Camera.look_at(eye, middle, up=field.up, width=size, height=size, fov_degrees=60)


def measure(field, camera, antialias: bool, peer, runs: int) -> dict:
    """Times in milliseconds: median and 95th percentile; and the agreement with the peer, dB."""

    def render():
        return field.render(camera, background=WHITE, antialias=antialias)

    if field.device.is_cpu:
        taken = [(time.process_time(), render(), time.process_time()) for _ in range(8)][2:]
        times = [1e3 * (end - begin) for begin, _, end in taken]
        return {"entries": field.renderer.entry_count, "processor_ms": round(statistics.median(times), 1)}
    actions, result = {"ms": render}, {}
    if peer is not None:
        theirs = peer_view(peer, field, camera, WHITE, antialias)
        one, two = theirs().cpu().numpy(), render()
        result["psnr_to_gsplat"] = float(warpcage.psnr(two.rgb, one))
        actions["gsplat_ms"] = theirs
    render()
    result["entries"] = field.renderer.entry_count
    times = times_by_turns(actions, field.device, runs)
    for name, taken in times.items():
        result[name] = [round(float(np.median(taken)), 4), round(float(np.percentile(taken, 95)), 4)]
    if peer is not None:
        result["gsplat_over_ours"] = round(result["gsplat_ms"][0] / result["ms"][0], 3)
    return result


def times_by_turns(actions, device, runs: int) -> dict[str, list[float]]:
    """Milliseconds of each action, by turns, after half a second in which the GPU takes up its clock."""
    begun = time.perf_counter()
    while time.perf_counter() - begun < 0.5:
        for action in actions.values():
            action()
    times: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(runs):
        for name, action in actions.items():
            wp.synchronize_device(device)
            begin = time.perf_counter()
            action()
            wp.synchronize_device(device)
            times[name].append(1e3 * (time.perf_counter() - begin))
    return times


if __name__ == "__main__":
    main()
