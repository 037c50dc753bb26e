"""A soft body of Newton falls on the ground and carries what it holds: its surface is the cage of a field.

    pip install newton
    python -m warpcage.examples newton_soft_body --field warpcage_demo/field.npz --out drop.mp4

Newton is no dependency of warpcage. Both work on the same device, and what Newton has moved is read where it lies.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import warp as wp

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.studio.films.video import write_video
from warpcage.view.camera import framing_orbit
from warpcage.view.pictures import to_uint8

FRAMES, RATE, STEPS = 40, 24, 16  # pictures, pictures a second, steps of the simulation for each
CELLS = (4, 3, 4)  # of the soft body


def soft_body(newton, bounds: np.ndarray, height: float, device):
    """A model of Newton: a box of tetrahedra, of bounds (2, 3) but `height` higher, and the ground below the bounds."""
    builder = newton.ModelBuilder()
    extent = bounds[1] - bounds[0]
    x, y, z = (float(side) for side in extent / CELLS)
    builder.add_soft_grid(
        pos=wp.vec3(*map(float, bounds[0] + [0.0, 0.0, height])),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        dim_x=CELLS[0],
        dim_y=CELLS[1],
        dim_z=CELLS[2],
        cell_x=x,
        cell_y=y,
        cell_z=z,
        density=100.0,
        k_mu=4e3,
        k_lambda=1e4,
        k_damp=1e-3,
    )
    builder.add_ground_plane(height=float(bounds[0, 2]))
    builder.color()
    return builder.finalize(device)


def surface(model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices and outward faces of a model's body, and which of its particles the vertices are."""
    rows, numbers = np.unique(model.tri_indices.numpy(), return_inverse=True)
    points, faces = model.particle_q.numpy()[rows].astype(np.float64), numbers.reshape(-1, 3)
    one, two, three = (points[faces[:, corner]] for corner in range(3))
    volume = np.einsum("ij,ij->", one, np.cross(two, three))
    return points, faces if volume > 0 else faces[:, ::-1], rows


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", default="warpcage_demo/field.npz", help="(default: %(default)s, of `warpcage demo`)")
    parser.add_argument("--out", default="drop.mp4", help="(default: %(default)s)")
    parser.add_argument("--size", type=int, default=240, help="pixels along each side (default: %(default)s)")
    parser.add_argument("--device")
    args = parser.parse_args(argv)
    try:
        import newton
    except ImportError:
        sys.exit("newton_soft_body.py needs newton: pip install newton")
    device = resolve_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device)
    middle, half = field.bounds.mean(axis=0), 0.5 * np.ptp(field.bounds, axis=0)
    bounds = np.stack([middle - 1.02 * half, middle + 1.02 * half])
    height = 0.5 * float(np.ptp(bounds[:, 2]))
    model = soft_body(newton, bounds, height, device)
    points, faces, rows = surface(model)
    rest = warpcage.Cage(points - [0.0, 0.0, height], faces)
    deformer = warpcage.Deformer(field, rest, resolution=48)
    solver, contacts = newton.solvers.SolverVBD(model, iterations=8), newton.CollisionPipeline(model)
    now, then, touching, control = model.state(), model.state(), contacts.contacts(), model.control()
    camera = framing_orbit(np.concatenate([points, rest.vertices]), 1, width=args.size, height=args.size)[0]
    pictures, heights = [], []
    for _ in range(FRAMES):
        for _ in range(STEPS):
            now.clear_forces()
            contacts.collide(now, touching)
            solver.step(now, then, control, touching, 1.0 / (RATE * STEPS))
            now, then = then, now
        moved = now.particle_q.numpy()[rows]
        heights.append(float(np.ptp(moved[:, 2])))
        pictures.append(to_uint8(deformer.pose(moved).render(camera).rgb))
    assert moved[:, 2].min() > bounds[0, 2] - 0.1 * height, "it fell through the ground"
    assert min(heights) < 0.98 * np.ptp(rest.vertices[:, 2]), "it did not give way"
    write_video(args.out, pictures, fps=RATE)
    print(f"wrote {args.out}: {FRAMES} pictures")


if __name__ == "__main__":
    main()
