"""How much of the test pictures of ground_truth.py the object covers, at rest and posed.

    python benchmarks/coverage.py --device cpu --json docs/results/coverage.json

The PSNR of a picture falls by 10 log10 of the share that is covered, whatever the field: what a pose loses or gains
that way is no fault of the deformation. Poses by mean value coordinates; the kinds differ little.
"""

from __future__ import annotations

import argparse

import numpy as np
import warp as wp
from results import write_results
from truth_scenes import SCENES, TruthScene, pose_cages

import warpcage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--test-views", type=int, default=4)
    parser.add_argument("--edge", type=float, default=0.15)
    parser.add_argument("--json")
    args = parser.parse_args()
    wp.config.quiet = True
    device = warpcage.core.devices.resolve_device(args.device)
    rows = []
    for name in SCENES:
        scene = TruthScene(
            name,
            size=args.size,
            train_views=1,
            test_views=args.test_views,
            longest_edge=args.edge,
            samples=1,
            cuts=1,
            device=device,
        )
        rest = covered(scene.rest_views())
        for pose, cage in pose_cages(name, scene.cage).items():
            posed = covered(scene.posed_views(cage, "mean_value")[0]["carried"])
            rows.append(
                {
                    "scene": name,
                    "pose": pose,
                    "rest": rest,
                    "posed": posed,
                    "decibels": float(-10 * np.log10(posed / rest)),
                }
            )
            print(rows[-1], flush=True)
    if args.json:
        write_results(args.json, device, size=args.size, test_views=args.test_views, rows=rows)


def covered(views) -> float:
    """Mean share of the pixels that the object covers."""
    return float(np.mean([np.isfinite(view.depth).mean() for view in views]))


if __name__ == "__main__":
    main()
