"""A step of a pipeline: torch arrays in and out, a fit that can be cancelled, a log, and frames as files.

    python examples/pipeline_step.py --out FOLDER

A field is fitted, posed by a torch tensor of cage vertices, rendered, and saved. Without torch it says so and ends.
"""

import argparse
import contextlib
import logging
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np

import warpcage

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--out", type=Path, help="folder of frames and of the log (default: one that is removed)")
arguments = parser.parse_args()
try:
    import torch
except ImportError:
    sys.exit("pipeline_step.py needs torch: pip install torch")


def make_scene():
    """Pictures of a ball, red above and blue below."""
    x, y, z = np.meshgrid(*[(np.arange(32) + 0.5) / 16 - 1] * 3, indexing="ij")
    sh = np.zeros((32, 32, 32, 9, 3))
    sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    ball = warpcage.VoxelField.from_dense(np.where(x**2 + y**2 + z**2 < 0.25, 60.0, 0.0), sh, [[-1] * 3, [1] * 3])
    cameras = warpcage.turntable((0, 0, 0), 3.0, 15, 8, width=40, height=40)
    return warpcage.Scene(np.stack([ball.render(camera).rgb for camera in cameras]), None, cameras, bounds=ball.bounds)


def fitted(scene, stop):
    """A field, or None where `stop` was set meanwhile: the work ends soon, and the device can be used."""

    def progress(done, total, words):
        logging.getLogger("pipeline").debug("%s: %d of %d", words, done, total)
        return not stop.is_set()

    with contextlib.suppress(warpcage.Cancelled):
        return warpcage.fit(scene, resolution=32, epochs=20, progress=progress)


def main(out):
    out.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(filename=out / "pipeline.log", level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")
    scene, stop = make_scene(), threading.Event()
    stop.set()  # as a farm's signal handler, or a button, would
    assert fitted(scene, stop) is None
    stop.clear()
    field = fitted(scene, stop)
    cage = warpcage.Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))
    turn = torch.tensor([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]])  # half a turn about y: blue comes up
    posed = torch.tensor(cage.vertices, dtype=torch.float32) @ turn.T
    deformer = warpcage.Deformer(field, cage, resolution=32).pose(posed)
    points = torch.rand(1000, 3) - 0.5
    there = warpcage.deform_points(points, cage, cage.with_vertices(posed))
    back, _, region = deformer.to_canonical(there, turn[:1].expand(1000, 3))
    assert isinstance(there, torch.Tensor) and back.device == points.device and (region == 2).all()
    assert torch.allclose(there, points @ turn.T, atol=1e-4) and torch.allclose(back, points, atol=1e-3)

    frame = deformer.render(scene.cameras[0], background="transparent")
    frame.save(out / "frame.png")  # colours with opacity
    frame.save(out / "frame.npz")  # also depth, masks and the camera
    assert frame.rgba[12, 20, 2] > frame.rgba[28, 20, 2]
    assert (out / "frame.png").stat().st_size > 500 and np.load(out / "frame.npz")["depth"].shape == (40, 40)
    assert "warpcage" in (out / "pipeline.log").read_text()
    print(f"one fit cancelled, one done: {field.voxel_count} voxels; frame.png, frame.npz and pipeline.log in {out}")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(arguments.out or Path(folder))
