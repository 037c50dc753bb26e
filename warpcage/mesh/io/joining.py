"""Vertices that programs split where normals, places in a texture or materials change, made one again."""

from __future__ import annotations

import numpy as np


def joined_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (v, n) that are exactly alike made one, in the order of the first of each.
    Returns (u,) the rows that stay, and (v,) the new number of each row."""
    _, first, place = np.unique(rows + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    return first[order], number[place.reshape(-1)]
