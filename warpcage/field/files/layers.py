"""Background layers inside field files: RGBA bytes of the nodes that pictures showed."""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.files import require_numbers
from ...core.memory import free_host_bytes
from .contents import LayerContents, surface_node_count

#: Names in the archive begin with this.
PREFIX = "layers_"

#: The arrays of background layers.
LAYER_NAMES = tuple(PREFIX + name for name in ("center", "half", "side", "count", "seen", "rgba", "unseen"))

#: Most cells along an edge of a cube, and most cubes.
MAX_SIDE, MAX_LAYERS = 8192, 1024

#: Values that differ from those of unseen nodes by more than this were seen.
SEEN_DIFFERENCE = 1e-6

#: Bytes that a node takes while it is read.
NODE_BYTES = 40


def layer_arrays(layers: LayerContents) -> dict[str, np.ndarray]:
    """The arrays of background layers, by name."""
    values, rest = layers.values, layers.unseen
    seen = np.ones(values.shape[:2], bool)
    if rest is not None:
        seen = (np.abs(values - rest) > SEEN_DIFFERENCE).any(axis=-1)
    rows = values[seen]
    # colours to 1/255 of [0, 1], optical depths as opacity to 1/255, below full opacity
    rgba = np.empty(rows.shape, np.uint8)
    rgba[:, :3] = np.rint(255 * np.clip(rows[:, :3], 0, 1))
    rgba[:, 3] = np.rint(255 * -np.expm1(-np.maximum(rows[:, 3], 0)))
    contents = {
        "center": layers.center,
        "half": np.array(layers.half),
        "side": np.array(layers.side),
        "count": np.array(len(values)),
        "seen": np.packbits(seen.ravel()),
        "rgba": rgba,
    }
    if rest is not None:
        contents["unseen"] = rest
    return {PREFIX + name: array for name, array in contents.items()}


def read_layers(contents: dict[str, np.ndarray], path: pathlib.Path) -> LayerContents | None:
    """The background layers of a file's arrays, or None where it has none; path: for messages."""
    if PREFIX + "side" not in contents:
        return None

    def read(name: str, shape: tuple[int, ...]) -> np.ndarray:
        return require_numbers(contents, PREFIX + name, shape, path)

    side, count = int(read("side", ())), int(read("count", ()))
    if not (2 <= side <= MAX_SIDE and 2 <= count <= MAX_LAYERS):
        raise ValueError(
            f"{path}: background layers must be 2 to {MAX_LAYERS} of 2 to {MAX_SIDE} cells along an edge, "
            f"got {count} of {side}"
        )
    shape = (count, surface_node_count(side))
    size = shape[0] * shape[1]
    if NODE_BYTES * size > free_host_bytes():
        raise ValueError(f"{path}: {count} background layers of {side} cells need more memory than is free")
    packed = read("seen", (-(-size // 8),))
    if packed.dtype != np.uint8:
        raise ValueError(f"{path}: {PREFIX}seen must be uint8, got {packed.dtype}")
    seen = np.unpackbits(packed, count=size).astype(bool).reshape(shape)
    rgba = read("rgba", (int(seen.sum()), 4))
    if rgba.dtype != np.uint8:
        raise ValueError(f"{path}: {PREFIX}rgba must be uint8, got {rgba.dtype}")
    unseen = read("unseen", (4,)).astype(np.float32) if PREFIX + "unseen" in contents else None
    if unseen is None and not seen.all():
        raise ValueError(f"{path} lacks {PREFIX}unseen")
    values = np.empty((*shape, 4), np.float32)
    values[...] = 0.0 if unseen is None else unseen
    values[seen, :3] = rgba[:, :3] / np.float32(255)
    values[seen, 3] = -np.log1p(-np.minimum(rgba[:, 3], 254.5) / 255)
    return LayerContents(read("center", (3,)), float(read("half", ())), side, values, unseen)
