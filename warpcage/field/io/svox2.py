"""Plenoxels (svox2) field files."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...core.checks import Cuts, warn_caller
from ...core.npz import require_numbers
from ...errors import InputError
from .field_file import BASIS_COUNT, HARMONICS, MAX_VOXELS, FieldContents, as_half, rgb_harmonics

#: Arrays that every svox2 file has.
SVOX2_KEYS = ("radius", "center", "links", "density_data", "sh_data", "basis_type")

#: The array of a svox2 file that holds its background layers.
SVOX2_LAYERS = "background_data"

#: svox2's number for spherical harmonics.
SVOX2_BASIS_SH = 1


def svox2_arrays(field: FieldContents, cuts: Cuts) -> dict[str, Any]:
    """The arrays of a svox2 file; layers, outer fields and harmonics of degree 3 are left out, with a warning."""
    if field.layers is not None:
        warn_caller("a svox2 file holds the field without its background layers")
    if field.outer is not None:
        warn_caller("a svox2 file holds the field without what is around its box (its outer field)")
    half = 0.5 * (field.bounds[1] - field.bounds[0])
    if field.sh.ndim == 2:
        warn_caller(
            "a svox2 file holds harmonics up to degree 2: those of degree 3 are left out, highlights get softer"
        )
    sh = rgb_harmonics(field.sh).transpose(0, 2, 1)  # (rows, rgb, basis), as svox2 has it
    return {
        "radius": half.astype(np.float32),
        "center": field.bounds.mean(axis=0).astype(np.float32),
        "links": field.links,
        "density_data": field.density[:, None],
        "sh_data": as_half(HARMONICS, sh.reshape(len(sh), -1), cuts),
        "basis_type": np.array(SVOX2_BASIS_SH),
    }


def read_svox2(contents: dict[str, np.ndarray], path: pathlib.Path, layered: bool) -> FieldContents:
    """The field of a svox2 file's arrays; layered: whether it has background layers, left out with a warning."""
    basis = int(require_numbers(contents, "basis_type", (), path))
    if basis != SVOX2_BASIS_SH:
        raise InputError(f"{path} has basis_type {basis}, only spherical harmonics (1) are read")
    if layered:
        warn_caller(f"the background layers of {path} are left out: only the field of a svox2 file is read")
    radius, center = (
        np.broadcast_to(require_numbers(contents, name, None, path).astype(np.float64).ravel(), (3,))
        if contents[name].size in (1, 3)
        else require_numbers(contents, name, (3,), path)
        for name in ("radius", "center")
    )
    coefficients = require_numbers(contents, "sh_data", (None, None), path).astype(np.float32)
    basis_count = coefficients.shape[-1] // 3
    if coefficients.ndim != 2 or basis_count * 3 != coefficients.shape[-1] or basis_count not in (1, 4, 9):
        raise InputError(f"{path}: sh_data must hold 3, 12 or 27 values per row, got {coefficients.shape}")
    sh = np.zeros((len(coefficients), BASIS_COUNT, 3), np.float32)
    sh[:, :basis_count] = coefficients.reshape(-1, 3, basis_count).transpose(0, 2, 1)
    links = require_numbers(contents, "links", (None, None, None), path)
    if links.dtype.kind != "i" or links.size > MAX_VOXELS:
        raise InputError(f"{path}: links must be at most {MAX_VOXELS} whole numbers, got {links.dtype} {links.shape}")
    links = np.clip(links, -1, np.iinfo(np.int32).max).astype(np.int32)  # svox2 may keep distances as negative links
    density = require_numbers(contents, "density_data", None, path).astype(np.float32).reshape(-1)
    return FieldContents(np.stack([center - radius, center + radius]), links, density, sh)
