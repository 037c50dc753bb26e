"""The .splat files of web viewers: 32 bytes a splat."""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.files import read_limited
from ...errors import InputError
from .contents import Y0, SplatContents, byte_logits, logs_of, opacities_of, unit_quaternions

_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])

_ROOM = 8


def read_splat(path: pathlib.Path) -> SplatContents:
    """The splats of a .splat file."""
    data = read_limited(path, "splat file", room=_ROOM)
    if len(data) % _ROW.itemsize:
        raise InputError(f"{path}: a .splat file has {_ROW.itemsize} bytes a splat, got {len(data)} bytes")
    table = np.frombuffer(data, _ROW)
    shares = table["color"] / 255.0
    return SplatContents(
        table["position"].astype(np.float32),
        logs_of(table["scale"]),
        ((table["rotation"].astype(np.float32) - 128.0) / 128.0),
        byte_logits(table["color"][:, 3]),
        ((shares[:, :3] - 0.5) / Y0).astype(np.float32)[:, None, :],
    )


def write_splat(contents: SplatContents) -> bytes:
    """A .splat file. Harmonics of degree 1 and up, which it has no place for, are left out."""
    table = np.zeros(contents.count, _ROW)
    table["position"] = contents.centers
    table["scale"] = np.exp(contents.log_scales.astype(np.float64))
    color = 0.5 + Y0 * contents.harmonics[:, 0].astype(np.float64)
    shares = np.column_stack([color, opacities_of(contents.logits)])
    table["color"] = np.clip(np.round(255.0 * shares), 0, 255)
    table["rotation"] = np.clip(np.round(128.0 * unit_quaternions(contents.quaternions) + 128.0), 0, 255)
    return table.tobytes()
