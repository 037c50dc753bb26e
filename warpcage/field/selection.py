"""Choose the object inside a larger field: by box, 2-D masks, seed point or connected part; leave floaters out.

A NodeSelection stands in for its field wherever densities are read: `Cage.from_field(selection)`,
`cage.check(field=selection)`, `extract_mesh(selection)`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .surface import node_grid

#: A node whose opacity across one voxel, or whose largest weight in any image, reaches this can be seen.
VISIBLE_OPACITY = 0.01


def visible_nodes(field, threshold: float | None = None) -> np.ndarray:
    """World positions (n, 3) of the nodes of a field that can be seen; see `visible_mask`."""
    visible = visible_mask(field, threshold)
    return np.asarray(field.bounds, dtype=np.float64)[0] + (np.argwhere(visible) + 0.5) * np.asarray(field.voxel_size)


def visible_mask(field, threshold: float | None = None) -> np.ndarray:
    """(nx, ny, nz) bool: the nodes of a field that can be seen.

    threshold: density from which a node counts, one over world units. None counts nodes whose largest recorded weight
    in an image (`field.node_weights()`) is at least 0.01, or, where no weights were recorded, whose opacity across one
    voxel is: density >= -ln(0.99) / voxel side.
    """
    densities, voxel_size = node_grid(field)
    weights = getattr(field, "node_weights", lambda: None)() if threshold is None else None
    if threshold is not None and not (np.isfinite(threshold) and threshold > 0.0):
        raise ValueError(f"threshold must be a positive density, got {threshold}")
    if weights is not None:
        return (np.asarray(weights) >= VISIBLE_OPACITY) & (densities > 0.0)
    if threshold is not None:
        return densities >= threshold
    return densities >= -np.log1p(-VISIBLE_OPACITY) / np.prod(voxel_size) ** (1.0 / 3.0)


@dataclasses.dataclass(frozen=True)
class NodeSelection:
    """Nodes of a field: mask (nx, ny, nz) bool, and notes, a line for each thing that was left out."""

    field: object
    mask: np.ndarray
    notes: tuple[str, ...]

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) bounds of the whole field, world units."""
        return self.field.bounds

    @property
    def voxel_size(self) -> np.ndarray:
        """(3,) world units."""
        return self.field.voxel_size

    @property
    def points(self) -> np.ndarray:
        """(n, 3) float64 world positions of the chosen nodes."""
        return _centres(self.field, np.argwhere(self.mask))

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) densities, zero outside the selection."""
        return np.where(self.mask, self.field.node_densities(), np.float32(0.0))

    def node_weights(self) -> np.ndarray | None:
        """(nx, ny, nz) largest rendering weights, zero outside the selection; None where the field has none."""
        weights = getattr(self.field, "node_weights", lambda: None)()
        return None if weights is None else np.where(self.mask, weights, np.float32(0.0))


def select_nodes(
    field,
    *,
    threshold: float | None = None,
    box=None,
    cameras=None,
    masks=None,
    seed=None,
    reach: float | None = None,
    parts: int | None = None,
    floaters: float = 0.0,
) -> NodeSelection:
    """The visible nodes of a field that belong to an object; each criterion given takes away from what is left.

    threshold: as in `warpcage.cage.generate.generate.visible_nodes`. box: (2, 3) corners, world units.
    cameras, masks: list of Camera and of (h, w) masks of their sizes, an object where above half their largest value;
    kept are nodes inside the mask in every picture that they fall into, and in at least one.
    seed: (3,) a point in or on the object; kept is what connects to the node nearest to it, with `reach`: no farther
    than that from the seed, world units. parts: the so many connected parts of most nodes.
    floaters: connected parts of fewer than this share of the largest one's nodes are dropped, 0 keeps all. Connected is
    over faces, edges and corners of voxels.
    Raises ValueError for values that make no sense, masks that do not fit their cameras, or where nothing is left.
    """
    mask = visible_mask(field, threshold)
    notes: list[str] = []
    _require_some(mask, "the field shows nothing")
    if box is not None:
        mask = _kept(mask, _in_box(field, mask, box), notes, "outside the box")
    if (cameras is None) != (masks is None):
        raise ValueError("cameras and masks go together, one mask a camera")
    if masks is not None:
        mask = _kept(mask, _in_masks(field, mask, list(cameras), list(masks)), notes, "outside the masks")
    if seed is not None:
        mask = _kept(mask, _grown(field, mask, seed, reach), notes, "not connected to the seed point")
    elif reach is not None:
        raise ValueError("reach needs a seed point to reach from")
    if parts is not None:
        if not isinstance(parts, int | np.integer) or parts < 1:
            raise ValueError(f"parts must be a whole number of at least 1, got {parts!r}")
        labels, sizes, order = _parts(mask)
        mask = _kept(mask, np.isin(labels, order[:parts]), notes, f"in {max(len(order) - parts, 0)} smaller parts")
    if not 0.0 <= floaters < 1.0:
        raise ValueError(f"floaters must be a share of the largest part, 0 to below 1, got {floaters}")
    if floaters > 0.0:
        labels, sizes, order = _parts(mask)
        large = order[sizes[order] >= floaters * sizes[order[0]]]
        most = sizes[order[len(large) :]].max(initial=0)
        where = f"in {len(order) - len(large)} floaters of up to {most} voxels"
        mask = _kept(mask, np.isin(labels, large), notes, where)
    return NodeSelection(field, mask, tuple(notes))


def _kept(mask, keep, notes, where) -> np.ndarray:
    left = mask & keep
    _require_some(left, f"all {np.count_nonzero(mask)} visible voxels are {where}")
    dropped = np.count_nonzero(mask) - np.count_nonzero(left)
    if dropped:
        notes.append(f"left out {dropped} visible voxels {where}")
    return left


def _require_some(mask, complaint) -> None:
    if not mask.any():
        raise ValueError(f"nothing is selected: {complaint}")


def _centres(field, cells) -> np.ndarray:
    return np.asarray(field.bounds, dtype=np.float64)[0] + (cells + 0.5) * np.asarray(field.voxel_size)


def _scattered(mask, cells, values) -> np.ndarray:
    result = np.zeros_like(mask)
    result[tuple(cells.T)] = values
    return result


def _in_box(field, mask, box) -> np.ndarray:
    box = np.asarray(box, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise ValueError(f"a box must be (2, 3), the lower corner first, got {box.tolist()}")
    cells = np.argwhere(mask)
    points = _centres(field, cells)
    return _scattered(mask, cells, ((points >= box[0]) & (points <= box[1])).all(axis=1))


def _in_masks(field, mask, cameras, masks) -> np.ndarray:
    if len(cameras) != len(masks) or not cameras:
        raise ValueError(f"one mask a camera is needed, got {len(masks)} masks and {len(cameras)} cameras")
    cells = np.argwhere(mask)
    points = _centres(field, cells)
    inside, seen = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    for number, (camera, picture) in enumerate(zip(cameras, masks, strict=True)):
        picture = np.asarray(picture)
        if picture.shape != (camera.height, camera.width):
            raise ValueError(
                f"mask {number} must be ({camera.height}, {camera.width}) as its camera, got {picture.shape}"
            )
        pixels, depth = camera.project(points)
        ahead = np.flatnonzero(depth > 0.0)
        column, row = np.floor(pixels[ahead]).astype(np.int64).T
        falls = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        ahead = ahead[falls]
        seen[ahead] = True
        top = picture.max()
        inside[ahead] &= picture[row[falls], column[falls]] > 0.5 * top if top > 0 else False
    return _scattered(mask, cells, inside & seen)


def _grown(field, mask, seed, reach) -> np.ndarray:
    seed = np.asarray(seed, dtype=np.float64)
    if seed.shape != (3,) or not np.isfinite(seed).all():
        raise ValueError(f"seed must be 3 finite numbers, got {seed.tolist()}")
    if reach is not None and not (np.isfinite(reach) and reach > 0.0):
        raise ValueError(f"reach must be positive, got {reach}")
    cells = np.argwhere(mask)
    distance = np.linalg.norm(_centres(field, cells) - seed, axis=1)
    nearest = int(np.argmin(distance))
    limit = 4.0 * float(np.max(field.voxel_size))
    if distance[nearest] > limit:
        raise ValueError(
            f"nothing visible is near the seed point {seed.tolist()}: the nearest voxel is "
            f"{distance[nearest]:.4g} away, more than 4 voxels"
        )
    if reach is not None:
        mask = _scattered(mask, cells, distance <= max(reach, distance[nearest]))
    labels, _, _ = _parts(mask)
    return labels == labels[tuple(cells[nearest])]


def _parts(mask) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Part number of each node (0 for none), nodes of each part, part numbers from the largest down."""
    import skimage.measure

    labels = skimage.measure.label(mask, connectivity=3)
    sizes = np.bincount(labels.reshape(-1))
    sizes[0] = 0
    order = np.argsort(-sizes, kind="stable")
    return labels, sizes, order[sizes[order] > 0]
