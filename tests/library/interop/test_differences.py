"""The difference that the backward pass of to_canonical goes through is the one that its forward pass takes."""

import numpy as np
import warp as wp
from fields import shiny_field, slotted

from warpcage import Deformer
from warpcage.kernels.edits.canonical_adjoint import difference_end
from warpcage.kernels.edits.structs import LatticeEdit
from warpcage.kernels.edits.trace import canonical_point, canonical_step

wp.set_module_options({"enable_backward": False})

STEP = 0.12  #: long, so that many points have no neighbour in the cage


@wp.kernel
def take_both(
    edits: wp.array(dtype=LatticeEdit),
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    dt: float,
    forward: wp.array(dtype=wp.vec3),
    backward: wp.array(dtype=wp.vec3),
    offsets: wp.array(dtype=float),
):
    n = wp.tid()
    x, d = points[n], directions[n]
    here = canonical_point(edits, x)
    if here.path == 0:
        return
    forward[n] = canonical_step(edits, x, d, dt, here, canonical_point(edits, x + dt * d))
    offset, there = difference_end(edits, x, d, dt, here)
    offsets[n] = offset
    if offset == 0.0:
        backward[n] = dt * d
    else:
        backward[n] = dt / offset * (there - here.position)


def test_both_passes_take_one_difference(device):
    rest, pose = slotted(0.4), slotted(0.02)  # across the slot a step is long in canonical space
    scene = Deformer(shiny_field(device), rest, coordinates="harmonic", resolution=32, device=device).pose(pose)
    rng = np.random.default_rng(0)
    count = 40_000
    points = rng.uniform([-0.85, -0.55, -0.45], [0.85, 0.65, 0.45], (count, 3))
    points[: count // 2, 0] *= 0.1  # about the slot
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, d = (wp.array(each, dtype=wp.vec3, device=device) for each in (points, directions))
    forward, backward = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    offsets = wp.zeros(count, dtype=float, device=device)
    inputs = [scene.posed_edits().array, x, d, STEP]
    wp.launch(take_both, count, inputs, [forward, backward, offsets], device=device)
    one, two, taken = forward.numpy(), backward.numpy(), np.round(offsets.numpy() / STEP, 4)
    assert np.abs(one - two).max() < 1e-6
    counts = {offset: int((taken == offset).sum()) for offset in (1.0, -1.0, 0.0625, -0.0625)}
    assert all(counts.values()) and sum(counts.values()) > 0.5 * count, counts
