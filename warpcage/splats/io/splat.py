"""The .splat files of web viewers: 32 bytes a splat."""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.files import read_limited
from .contents import Y0, SplatContents, logits_of, opacities_of

_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])

_ROOM = 8

_ALPHA_EDGE = 0.25 / 255.0


def read_splat(path: pathlib.Path) -> SplatContents:
    """The splats of a .splat file."""
    data = read_limited(path, "splat file", room=_ROOM)
    if len(data) % _ROW.itemsize:
        raise ValueError(f"{path}: a .splat file has {_ROW.itemsize} bytes a splat, got {len(data)} bytes")
    table = np.frombuffer(data, _ROW)
    scales = table["scale"].astype(np.float64)
    if not (np.isfinite(scales).all() and (scales > 0.0).all()):
        row = int(np.argwhere(~(np.isfinite(scales) & (scales > 0.0)))[0][0])
        raise ValueError(f"{path}: splat {row} has a scale that is not positive: {scales[row].tolist()}")
    shares = table["color"] / 255.0
    return SplatContents(
        table["position"].astype(np.float32),
        np.log(scales).astype(np.float32),
        ((table["rotation"].astype(np.float32) - 128.0) / 128.0),
        logits_of(np.clip(shares[:, 3], _ALPHA_EDGE, 1.0 - _ALPHA_EDGE)),
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
    length = np.linalg.norm(contents.quaternions.astype(np.float64), axis=1, keepdims=True)
    unit = np.where(length > 0.0, contents.quaternions / np.where(length > 0.0, length, 1.0), [1.0, 0.0, 0.0, 0.0])
    table["rotation"] = np.clip(np.round(128.0 * unit + 128.0), 0, 255)
    return table.tobytes()
