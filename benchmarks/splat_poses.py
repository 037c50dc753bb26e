"""Poses of splats: 300,000 under a cage of about 100 vertices, new poses each time.

    python benchmarks/splat_poses.py [--count 300000] [--kinds mean_value harmonic green]

Prints, for each kind of coordinates, how long binding takes once; a pose from the call to the last kernel (the check of
the cage, sums, covariances, turns, splits); and its kernels alone, of which the first sums up centres and Jacobians.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.deform.splat_instances import BOUND


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


def timed(run, device, rounds: int = 30) -> list[float]:
    """Milliseconds of each call, the device waited for."""
    times = []
    for number in range(rounds + 5):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        run(number)
        wp.synchronize_device(device)
        times.append(1e3 * (time.perf_counter() - begin))
    return times[5:]


def shown(times: list[float]) -> str:
    return f"{np.median(times):.3f} ms (95 %: {np.percentile(times, 95):.3f})"


def measure(field, cage, poses, kind: str, rounds: int) -> None:
    """Print how long one kind of coordinates takes."""
    device = field.device
    begin = time.perf_counter()
    deformer = warpcage.Deformer(field, cage, coordinates=kind)
    wp.synchronize_device(device)
    bound = time.perf_counter() - begin
    edits = deformer._edits
    nodes, pieces = len(edits.tree.rows), int((edits.tree.pieces >= 0).sum())
    whole = timed(lambda k: deformer.pose(poses[k]), device, rounds)
    kernels = timed(lambda k: edits.pose([poses[k]]), device, rounds)
    first = edits._bound[0]
    binding, members = first.binding, (first.members[BOUND], first.anchors, first.offsets, edits.carried)
    sums = timed(lambda k: binding.carry(poses[k], *members), device, rounds)
    drawn = int((deformer.posed_splats().opacities.numpy() > 0).sum())
    print(f"{kind}: bound in {bound:.2f} s, {nodes} nodes, {pieces} with pieces, {drawn} drawn")
    print(f"  pose with its checks {shown(whole)}; without {shown(kernels)}; centres and Jacobians {shown(sums)}")
    if device.is_cuda:
        with wp.ScopedTimer("kernels", cuda_filter=wp.TIMING_KERNEL, synchronize=True, print=False) as timer:
            edits.pose([poses[0]])
        for result in timer.timing_results:
            print(f"    {result.name}: {result.elapsed:.4f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300_000)
    parser.add_argument("--device")
    parser.add_argument("--kinds", nargs="+", default=["mean_value", "harmonic", "green"])
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    device = resolve_device(args.device)
    field = scene(args.count, device)
    cage = warpcage.Cage.box((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), segments=4)
    poses = [cage.twist(20 + 3 * k).bend(10 + 2 * k) for k in range(args.rounds + 5)]
    print(f"{device.name}: {args.count} splats, cage of {len(cage.vertices)} vertices, {len(cage.faces)} faces")
    for kind in args.kinds:
        measure(field, cage, poses, kind, args.rounds)


if __name__ == "__main__":
    main()
