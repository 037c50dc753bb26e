"""How fast harmonic coordinates on a lattice approach boundary elements as the lattice is refined.

    python benchmarks/convergence.py --json convergence.json

Harmonic weights of a convex cage (an icosphere with displaced vertices) and of a concave one (an L) at inside points
clear of the cage by 0.1 of its size, against boundary elements in float64 on faces that are cut finer towards edges
(the fluxes of weights are singular there). Printed are RMS and largest error a resolution, the order between one
resolution and the next, and what two cuts of the reference differ by, below which nothing can be read; then the
largest error at points up to the cage.
"""

import argparse
import json
import pathlib
import sys

import numpy as np
import warp as wp

import warpcage
from warpcage.coordinates.harmonic import harmonic_weights

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "tests"))
import oracles  # noqa: E402
from test_containment import reference_distance  # noqa: E402

#: Orders asked for, and over which resolutions they are fitted: those that the reference can still tell.
CASES = {"icosphere": 1.7, "concave": 1.2}


def clear_points(vertices, faces, count):
    points = oracles.inside_points(vertices, faces, 12 * count)
    return points[reference_distance(points, vertices, faces) > 0.1 * np.ptp(vertices, axis=0).max()][:count]


def points_up_to_the_cage(vertices, faces, count):
    """Random inside points, and such within a hundredth of the size of random places of the faces."""
    random = np.random.default_rng(2)
    chosen = faces[random.integers(len(faces), size=count)]
    normal = np.cross(vertices[chosen[:, 1]] - vertices[chosen[:, 0]], vertices[chosen[:, 2]] - vertices[chosen[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    places = np.einsum("nk,nkc->nc", random.dirichlet([1, 1, 1], count), vertices[chosen])
    near = places - np.ptp(vertices, axis=0).max() * random.uniform(1e-4, 1e-2, (count, 1)) * normal
    near = near[oracles.winding_numbers(near, vertices, faces) > 0.5]
    return np.concatenate([oracles.inside_points(vertices, faces, count), near])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--resolution", type=int, nargs="*", default=[16, 24, 32, 48, 64, 96, 128])
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--cuts", type=int, nargs=2, default=[4, 6], help="levels of graded cuts of the two references")
    parser.add_argument("--json")
    args = parser.parse_args()
    wp.config.quiet = True
    rows = []
    for name, wanted in CASES.items():
        vertices, faces = oracles.cage(name)
        clear = clear_points(vertices, faces, args.points)
        points = np.concatenate([clear, points_up_to_the_cage(vertices, faces, args.points)])
        coarse, reference = (
            oracles.harmonic_oracle(vertices, faces, np.eye(len(vertices)), points, graded=cuts) for cuts in args.cuts
        )
        between = (coarse - reference)[: len(clear)]
        floor = np.sqrt((between**2).mean())
        print(
            f"{name}: {len(clear)} clear points, references differ by {floor:.1e} RMS, "
            f"{np.abs(between).max():.1e} at most; {len(points) - len(clear)} up to the cage, "
            f"{np.abs(coarse - reference).max():.1e} at most"
        )
        errors, last = [], None
        for resolution in args.resolution:
            weights = harmonic_weights(points, warpcage.Cage(vertices, faces), resolution, args.device, tolerance=2e-6)
            up_to_cage = float(np.abs(weights - reference).max())
            error = (weights - reference)[: len(clear)]
            errors.append(float(np.sqrt((error**2).mean())))
            order = np.log(errors[-2] / errors[-1]) / np.log(resolution / last) if len(errors) > 1 else None
            last = resolution
            rows.append(
                {
                    "cage": name,
                    "resolution": resolution,
                    "rms": errors[-1],
                    "largest": float(np.abs(error).max()),
                    "up_to_cage": up_to_cage,
                    "order": order,
                    "reference_rms": float(floor),
                }
            )
            line = (
                "  {resolution:4d}  rms {rms:.2e}  largest {largest:.2e}  to the cage {up_to_cage:.2e}  order {order}"
            )
            print(line.format(**rows[-1] | {"order": "-" if order is None else f"{order:.2f}"}), flush=True)
        seen = np.array(errors) > floor
        x, y = np.log(np.array(args.resolution)[seen]), np.log(np.array(errors)[seen])
        fitted = float(-np.polyfit(x, y, 1)[0])
        rows.append({"cage": name, "fitted_order": fitted, "wanted": wanted})
        print(f"  fitted order {fitted:.2f} over {seen.sum()} resolutions, wanted {wanted}")
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump({"warp": wp.__version__, "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
