"""Where a fit's device time goes, kernel by kernel, at each level.

python benchmarks/fit_profile.py --data ../shared/data/lego_800 --device cuda:0
"""

import argparse
import ast
import collections

import warp as wp

import warpcage
from warpcage.fitting.optimizer import FieldOptimizer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--option", nargs="*", default=[], help="FitOptions as name=value")
    args = parser.parse_args()
    wp.config.quiet = True
    options = {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in args.option)}
    scene = warpcage.load_scene(args.data, downscale=args.downscale)
    optimizer = FieldOptimizer(scene, device=args.device, **options)
    level = -1
    while optimizer.step_count < optimizer.total_steps:
        start = optimizer.step_count - sum(optimizer.level_steps[: optimizer.level])
        middle = optimizer.level_steps[optimizer.level] // 2
        if optimizer.level != level and start == middle:
            level, count = optimizer.level, min(20, middle)
            wp.timing_begin(cuda_filter=wp.TIMING_ALL)
            for _ in range(count):
                optimizer.step()
            total = collections.Counter()
            for result in wp.timing_end():
                total[result.name] += result.elapsed / count
            print(
                f"level {level}: {optimizer.field.resolution}, {optimizer.field.voxel_count} voxels, "
                f"{optimizer.batch_rays} rays; ms a step"
            )
            for name, milliseconds in total.most_common(8):
                print(f"  {milliseconds:9.3f}  {name}")
        else:
            optimizer.step()


if __name__ == "__main__":
    main()
