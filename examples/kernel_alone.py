"""One kernel file in a bare Warp program: bend a cloud of points with mean value coordinates.

    python examples/kernel_alone.py

The command `warpcage kernels copy mean_value DEST --alone` copies a kernel file with those that it needs into a
package. This program copies them to a temporary folder and imports the copy: nothing else of the library is used.
"""

import argparse
import subprocess
import sys
import tempfile

import numpy as np
import warp as wp

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads

with tempfile.TemporaryDirectory() as folder:
    command = [sys.executable, "-m", "warpcage", "kernels", "copy", "mean_value", f"{folder}/borrowed", "--alone"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    sys.path.insert(0, folder)
    from borrowed.coordinates.mean_value import mean_value_position
    from borrowed.mesh.fans import prepare_fans


@wp.kernel
def move_points(
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    moved: wp.array(dtype=wp.vec3),
):
    """The device function runs inside any kernel: here one point per thread."""
    tid = wp.tid()
    moved[tid] = mean_value_position(points[tid], vertices, faces, fans, targets, size)


def main():
    assert "warpcage" not in sys.modules
    device = wp.get_preferred_device()
    # an octahedron as cage, counterclockwise seen from outside
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    upper = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4]], np.int32)
    triangles = np.concatenate([upper, np.where(upper == 4, 5, upper)[:, ::-1]])
    cloud = np.random.default_rng(0).uniform(-0.3, 0.3, (10_000, 3)).astype(np.float32)

    vertices, points = wp.array(corners, dtype=wp.vec3, device=device), wp.array(cloud, dtype=wp.vec3, device=device)
    faces = wp.array(triangles, dtype=wp.vec3i, device=device)
    moved = wp.empty_like(points)
    fans = wp.empty(2 * len(triangles), dtype=wp.vec4, device=device)
    wp.launch(prepare_fans, len(triangles), [0, vertices, faces, 2.0], [fans], device=device, record_tape=False)

    def move(targets):
        there = wp.array(targets.astype(np.float32), dtype=wp.vec3, device=device)
        inputs = [points, vertices, faces, fans, there, 2.0]
        wp.launch(move_points, dim=len(cloud), inputs=inputs, outputs=[moved], device=device)
        return moved.numpy()

    # mean value coordinates reproduce every affine map
    shear = np.array([[1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [-0.2, 0.0, 1.1]])
    error = np.abs(move(corners @ shear.T + 0.5) - (cloud @ shear.T + 0.5)).max()
    lift = (move(corners + np.array([[0, 0, 1.0]] + [[0, 0, 0]] * 5)) - cloud)[:, 2]  # drag the corner at +x upwards
    print(f"affine map off by {error:.1e}; one corner up by 1 lifts points by {lift.min():.2f} to {lift.max():.2f}")
    assert error < 1e-5
    assert 0.0 < lift.min() < lift.max() < 1.0 and np.corrcoef(lift, cloud[:, 0])[0, 1] > 0.9


if __name__ == "__main__":
    main()
