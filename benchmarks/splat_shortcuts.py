"""Shortcuts of other tools with posed splats, so that their cost can be measured. For benchmarks only.

no turn: harmonics as they are at rest.
no split: splats that are large beside the bend stay whole.
full opacity: the pieces of a split splat are as opaque as the whole.
GSDeformer: seven points of each splat, its centre and one standard deviation along each axis both ways, are moved by
mean value coordinates; half the differences are its new axes; where the two halves of an axis turn against each other
by more than 15 degrees it is cut in two there, both as opaque as the whole; harmonics as they are (after Huang et al.,
"GSDeformer", 2024: our own reading of it).
"""

from __future__ import annotations

import contextlib

import numpy as np
import warp as wp

import warpcage
from warpcage.deform import splat_edits
from warpcage.deform.splat_deformer import quaternions_of
from warpcage.kernels.splats.splats import Splats
from warpcage.splats import binding
from warpcage.splats.splat_field import SplatField

#: Two halves of an axis that turn against each other by more than this are cut apart, degrees.
CUT_DEGREES = 15.0


def without_turns(splats):
    """The same splats with harmonics as they are at rest."""
    plain = Splats()
    for name in ("centres", "covariances", "opacities", "harmonics", "degree", "rows"):
        setattr(plain, name, getattr(splats, name))
    plain.turns = wp.empty(0, dtype=wp.quat, device=splats.centres.device)
    return plain


def without_splits():
    """A context in which Deformers leave every splat whole."""
    return _constants(splat_edits, LARGE=1e30)


def with_opaque_pieces():
    """A context in which the pieces of a splat are as opaque as the whole."""
    table = binding._TABLE.copy()
    table[:, 1] = table[:, 2] = table[:, 0]
    return _constants(binding, _TABLE=table)


@contextlib.contextmanager
def _constants(module, **values):
    """Other values of a module's constants, for a while."""
    before = {name: getattr(module, name) for name in values}
    vars(module).update(values)
    try:
        yield
    finally:
        vars(module).update(before)


def gsdeformer(field: SplatField, cage, posed) -> SplatField:
    """The field as seven points of each splat deform it."""
    held = field.contents
    centres, axes = held.centres.astype(np.float64), field.rotations * field.scales[:, None, :]
    rows = np.arange(len(field))
    for axis in range(3):  # where it is bent it is cut in two
        low, middle, high = _moved_points(cage, posed, centres, axes[:, :, axis])
        halves = [(ends / np.linalg.norm(ends, axis=1, keepdims=True)) for ends in (middle - low, high - middle)]
        bent = np.einsum("ij,ij->i", *halves) < np.cos(np.radians(CUT_DEGREES))
        half = 0.5 * axes[bent, :, axis]
        pieces = axes[bent].copy()
        pieces[:, :, axis] = half
        centres = np.concatenate([centres[~bent], centres[bent] - half, centres[bent] + half])
        axes = np.concatenate([axes[~bent], pieces, pieces])
        rows = np.concatenate([rows[~bent], rows[bent], rows[bent]])
    ends = [_moved_points(cage, posed, centres, axes[:, :, axis]) for axis in range(3)]
    factors = np.stack([(high - low) / 2 for low, _, high in ends], axis=2)
    turns, scales, _ = np.linalg.svd(factors)
    turns[:, :, 2] *= np.sign(np.linalg.det(turns))[:, None]
    values = np.log(np.maximum(scales, 1e-12)), quaternions_of(turns), held.logits[rows], held.harmonics[rows]
    return SplatField(ends[0][1], *values, background="white", up=field.up, device=field.device)


def _moved_points(cage, posed, centres, offsets) -> list[np.ndarray]:
    """Where mean value coordinates take the points before, in and behind each centre."""
    return [warpcage.deform_points(centres + side * offsets, cage, posed) for side in (-1, 0, 1)]
