"""Poses of splats: 300,000 under a cage of about 100 vertices, new poses each time.

    python benchmarks/splat_poses.py [--count 300000] [--kinds mean_value harmonic green] [--json results.json]

Prints, for each kind of coordinates, how long binding takes once; a pose from the call to the last kernel (the check of
the cage, sums, covariances, turns, splits), the same without the check, and its centres and Jacobians alone; and on
CUDA each of its kernels. All of it twice: with pieces for splats that a pose may bend, which are bound and carried too,
and of the same splats left whole, so that there are as many sums as splats. Every pose is new: what a cage was found to
be is remembered with it. A GPU is kept busy for half a second before each figure, as its clock goes down where nothing
runs.
"""

from __future__ import annotations

import argparse
import contextlib
import time

import numpy as np
import warp as wp
from results import write_results
from splat_shortcuts import without_splits

import warpcage
from warpcage.core.devices import resolve_device

#: How long a GPU is kept busy before each figure, and poses that are not counted.
WARM_SECONDS, UNCOUNTED = 0.5, 5


def scene(count: int, device, large: float = 0.02) -> warpcage.SplatField:
    """Splats on a sphere of radius one, as thick as fits make them, a share of them large."""
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(count, 3))
    centres *= rng.uniform(0.9, 1.0, (count, 1)) / np.linalg.norm(centres, axis=1, keepdims=True)
    scales = np.log(0.004) + 0.6 * rng.normal(size=(count, 3))
    scales[rng.uniform(size=count) < large] += np.log(12.0)
    harmonics = 0.2 * rng.normal(size=(count, 16, 3))
    quaternions, logits = rng.normal(size=(count, 4)), rng.normal(size=count)
    return warpcage.SplatField(centres.astype(np.float32), scales, quaternions, logits, harmonics, device=device)


def timed(run, poses, device) -> list[float]:
    """Milliseconds of run() of each pose, the device waited for; the first few, and half a second, are not counted."""
    begin = time.perf_counter()
    while device.is_cuda and time.perf_counter() - begin < WARM_SECONDS:
        run(poses[0])
        wp.synchronize_device(device)
    times = []
    for pose in poses:
        wp.synchronize_device(device)
        begin = time.perf_counter()
        run(pose)
        wp.synchronize_device(device)
        times.append(1e3 * (time.perf_counter() - begin))
    return times[UNCOUNTED:]


def kernel_times(edits, poses, device) -> dict[str, float]:
    """Milliseconds of each kernel, and fill or copy, of a pose: medians; by name."""
    found: dict[str, list[float]] = {}
    for pose in poses[:UNCOUNTED]:
        with wp.ScopedTimer("kernels", cuda_filter=wp.TIMING_ALL, synchronize=True, print=False) as timer:
            edits.pose([pose])
        for result in timer.timing_results:
            found.setdefault(result.name, []).append(result.elapsed)
    return {name: float(np.median(times)) for name, times in found.items()}


def shown(times: list[float]) -> str:
    return f"{np.median(times):.3f} ms (95 %: {np.percentile(times, 95):.3f})"


def measure(field, cage, kind: str, rounds: int, whole: bool) -> dict:
    """Print how long one kind of coordinates takes, of splats in pieces or left whole; the same as a row of results."""
    device = field.device
    begin = time.perf_counter()
    with without_splits() if whole else contextlib.nullcontext():
        deformer = warpcage.Deformer(field, cage, coordinates=kind)
    wp.synchronize_device(device)
    bound = time.perf_counter() - begin
    edits = deformer._edits
    first = edits._bound[0]
    nodes, pieces = len(edits.tree.rows), int((edits.tree.pieces >= 0).sum())

    def poses():
        return [cage.twist(20 + 3 * k).bend(10 + 2 * k) for k in range(rounds + UNCOUNTED)]

    found = {
        "pose": timed(deformer.pose, poses(), device),
        "without_check": timed(lambda pose: edits.pose([pose]), poses(), device),
        "centres_and_jacobians": timed(
            lambda pose: first.binding.carry(pose, *first.carriers, edits.carried), poses(), device
        ),
    }
    drawn = int((deformer.posed_splats().opacities.numpy() > 0).sum())
    row = {
        "kind": kind,
        "whole": whole,
        "bind_s": bound,
        "nodes": nodes,
        "carried": first.carriers[0].size,
        "with_pieces": pieces,
        "drawn": drawn,
        **{f"{name}_ms": np.median(times) for name, times in found.items()},
        **{f"{name}_95_ms": np.percentile(times, 95) for name, times in found.items()},
    }
    name = f"{kind}, left whole" if whole else kind
    print(f"{name}: bound in {bound:.2f} s, {nodes} nodes, {pieces} with pieces, {drawn} drawn; {row['carried']} sums")
    checked, unchecked, sums = (shown(times) for times in found.values())
    print(f"  pose with its checks {checked}; without {unchecked}; centres and Jacobians {sums}")
    if device.is_cuda:
        row["kernels_ms"] = kernel_times(edits, poses(), device)
        for name, milliseconds in row["kernels_ms"].items():
            print(f"    {name}: {milliseconds:.4f} ms")
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300_000)
    parser.add_argument("--device")
    parser.add_argument("--kinds", nargs="+", default=["mean_value", "harmonic", "green"])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    device = resolve_device(args.device)
    field = scene(args.count, device)
    cage = warpcage.Cage.box((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), segments=4)
    print(f"{device.name}: {args.count} splats, cage of {len(cage.vertices)} vertices, {len(cage.faces)} faces")
    rows = [measure(field, cage, kind, args.rounds, whole) for kind in args.kinds for whole in (False, True)]
    if args.json:
        write_results(args.json, device, splats=args.count, cage_vertices=len(cage.vertices), poses=rows)


if __name__ == "__main__":
    main()
