"""Files for tests of the command line, and how they run commands on them."""

import numpy as np

from warpcage import Cage, VoxelField
from warpcage.cli import main
from warpcage.reference import write_brick_scene

DEFORMED = ("--cage", "@cage.obj", "--posed", "@posed.obj")
SMALL = ("--size", "40", "--coordinates", "mean_value", "--resolution", "24")


def write_files(folder):
    """A ball as field and mesh, a box around it at rest and posed, a small scene."""
    x, y, z = np.meshgrid(*[(np.arange(24) + 0.5) / 12 - 1] * 3, indexing="ij")
    density = np.where(x**2 + y**2 + z**2 < 0.3, 40.0, 0.0)
    sh = np.zeros((24, 24, 24, 9, 3))
    sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]]).save(folder / "ball.npz")
    cage = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7), segments=2)
    cage.save(folder / "cage.obj")
    cage.bend(40, axis="x", towards="z").save(folder / "posed.obj")
    Cage(cage.vertices, cage.faces[1:]).save(folder / "open.obj")
    Cage(cage.vertices, cage.faces[:, ::-1]).save(folder / "inward.obj")
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7)).save(folder / "other.obj")
    Cage(cage.vertices, np.roll(cage.faces, 1, axis=0)).save(folder / "shuffled.obj")
    (folder / "text.txt").write_text("text")
    (folder / "broken.npz").write_bytes(b"no archive")
    (folder / "broken.obj").write_text("v 0 0 zero\n")
    (folder / "empty").mkdir()
    write_brick_scene(folder / "scene", train_views=6, test_views=2, size=24)
    return folder


def run(files, *words):
    """main with file names of the folder put in for {name}."""
    return main([str(word).replace("@", f"{files}/") for word in words])


def succeed(files, *words):
    assert run(files, *words) == 0
