"""Selections of voxels: by box, ball, cage or what pictures showed, cut to connected parts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import (
    checked_bounds,
    checked_number,
    checked_positive,
    checked_vector,
    checked_whole,
    require_type,
    shown,
)
from ..core.files import PathLike
from ..core.names import counted
from ..errors import InputError
from ..field.io.field_file import Y0
from ..field.sparse import harmonics_on_host, stored_harmonics
from ..field.surface import DensityField, node_grid
from ..field.voxel_field import VoxelField
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import inside_mesh
from ..view.camera import Camera
from ..view.frame import Frame
from .planes import Plane
from .selection_file import SelectionContents, load_selection, occupancy_digest, same_box, save_selection

#: Optical depth of a voxel that counts as empty.
RIM_DEPTH = 0.01

#: Colour of the tint of chosen nodes, and its share.
TINT, TINT_SHARE = (0.1, 0.9, 0.2), 0.55


def cut_out(field: VoxelField, mask: np.ndarray) -> VoxelField:
    """A field of the voxels of a mask (nx, ny, nz) bool alone, before the field's colour.
    Its box ends a voxel beyond them, so that views show that large; density falls to zero over this voxel."""
    from scipy.ndimage import binary_dilation

    if not mask.any():
        raise InputError("nothing is chosen that could be cut out")
    links = field.host_links()
    grown = np.asarray(binary_dilation(mask, np.ones((3, 3, 3), bool)), bool)
    ends = [np.flatnonzero(grown.any(axis=others))[[0, -1]] + (0, 1) for others in ((1, 2), (0, 2), (0, 1))]
    block = tuple(slice(*each) for each in ends)
    links, mask = links[block], mask[block]
    kept = grown[block] & (links >= 0)
    rows, inside = links[kept], mask[kept]
    bounds = field.bounds[0] + np.transpose(ends) * field.voxel_size
    density = field.stored.density.numpy()[rows]
    density = np.where(inside, density, np.minimum(density, 0.0)).astype(np.float32)
    new = np.full(links.shape, -1, np.int32)
    new[kept] = np.arange(len(rows), dtype=np.int32)
    weights = None if field.weights is None else np.where(inside, field.weights.numpy()[rows], np.float32(0.0))
    options = {**field.view_options(), "background_model": None}
    sh = harmonics_on_host(stored_harmonics(field.stored))[rows]
    return VoxelField(bounds, new, density, sh, weights=weights, device=field.device, **options)


def tinted_view(
    field: Any, mask: np.ndarray, camera: Camera, *, color: ArrayLike = TINT, strength: float = TINT_SHARE
) -> np.ndarray:
    """A view (h, w, 3) float32 in [0, 1], the nodes of a mask (nx, ny, nz) bool tinted as far as they are seen.
    field: of voxels, or the matter of splats; strength: share of the tint where nothing else is seen, 0 to 1."""
    of_splats = splat_matter(field)
    # the same matter, white where it is chosen: what a pixel shows of it is the chosen share of its light
    white = painted_voxels(field, mask) if of_splats is None else of_splats.painted(mask)
    seen = white.render(camera, supersampling=getattr(field, "supersampling", None))
    return tinted(field.render(camera).rgb, seen, color, strength)


def tinted(rgb: np.ndarray, white: Frame, color: ArrayLike = TINT, strength: float = TINT_SHARE) -> np.ndarray:
    """A picture (h, w, 3) float32 in [0, 1], tinted where a view of the same matter in black and white is white."""
    share = strength * white.rgb[..., :1].clip(0.0, 1.0)
    return (np.clip(rgb, 0.0, 1.0) * (1.0 - share) + share * np.asarray(color, np.float32)).astype(np.float32)


def painted_voxels(field: VoxelField, mask: np.ndarray) -> VoxelField:
    """A field of the same matter before black, white in the voxels of a mask (nx, ny, nz) bool and black elsewhere."""
    from scipy.ndimage import binary_dilation

    links = field.host_links()
    rows = np.zeros(field.voxel_count, bool)
    # a surface lies between voxels that are chosen and empty ones, which are the chosen matter's rim
    rim = links[np.asarray(binary_dilation(mask, np.ones((3, 3, 3), bool)), bool) & (links >= 0)]
    rows[rim] = field.stored.density.numpy()[rim] * field.voxel_size.max() < RIM_DEPTH
    rows[links[mask & (links >= 0)]] = True
    shown = np.zeros((field.voxel_count, 9, 3), np.float32)
    shown[:, 0] = np.where(rows, 0.5, -0.5)[:, None] / Y0
    return VoxelField(
        field.bounds, links, field.stored.density, shown, background="black", up=field.up, device=field.device
    )


def splat_matter(field: Any) -> Any:
    """The densities on a grid (SplatDensity) of a field of splats, or of what was taken of them; None of voxels."""
    whole: Any = root_field(field)
    if hasattr(whole, "splats_in"):
        return whole
    return whole.matter() if hasattr(whole, "matter") else None


#: Pixels along the longer side of the views that depths are taken from.
DEPTH_PIXELS = 200

#: A view shows a node that lies within so many voxels of the depth that it has there, where it is half opaque.
DEPTH_VOXELS = 2.0


def in_masks(points: np.ndarray, cameras: list[Camera], masks: list[ArrayLike]) -> np.ndarray:
    """Which points (n, 3), world units, are inside the mask of every picture that they fall into, and fall into one.
    masks: one (h, w) per camera, the object where it is above half its largest value."""
    if len(cameras) != len(masks) or not cameras:
        raise InputError(f"one mask per camera is needed, got {len(masks)} masks and {len(cameras)} cameras")
    inside, seen = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    for number, (camera, given) in enumerate(zip(cameras, masks, strict=True)):
        picture = np.asarray(given)
        if picture.shape != (camera.height, camera.width):
            raise InputError(
                f"mask {number} must be ({camera.height}, {camera.width}) as its camera, got {picture.shape}"
            )
        ahead, row, column = _fallen(points, camera)
        seen[ahead] = True
        top = picture.max()
        inside[ahead] &= picture[row, column] > 0.5 * top if top > 0 else False
    return inside & seen


def in_depths(points: np.ndarray, field: VoxelField, cameras: list[Camera], depth: ArrayLike) -> np.ndarray:
    """Which points (n, 3) of a field's matter the views show at distances in a range, and what is hidden behind those.
    depth: (2,) least and largest distance from the camera along the ray, world units."""
    values = np.asarray(depth, np.float64) if np.shape(depth) == (2,) else np.full(2, np.nan)
    near, far = (checked_number(each, "depth") if np.isfinite(each) else np.nan for each in values)
    if not 0.0 <= near < far:
        raise InputError(f"depth must be two distances from the cameras, the nearer one first, got {depth!r}")
    if not cameras:
        raise InputError("depth needs the cameras of the views")
    within, without, hidden, through = (np.zeros(len(points), int) for _ in range(4))
    room = DEPTH_VOXELS * float(np.max(field.voxel_size))
    for camera in cameras:
        shrink = min(1.0, DEPTH_PIXELS / max(camera.width, camera.height))
        small = camera.resized(*(max(1, round(shrink * side)) for side in (camera.width, camera.height)))
        frame = field.render(small, background="black", supersampling=1)
        ahead, row, column = _fallen(points, small)
        distance = np.linalg.norm(points[ahead] - small.center, axis=1)
        opaque = frame.alpha[row, column] >= 0.5
        behind = distance - np.where(opaque, frame.depth[row, column], np.inf)
        # in front of what it shows a view looks through haze, behind it there is what it cannot see
        shown, fits = np.abs(behind) <= room, (distance >= near) & (distance <= far)
        within[ahead[shown & fits]] += 1
        without[ahead[shown & ~fits]] += 1
        hidden[ahead[behind > room]] += 1
        through[ahead[behind < -room]] += 1
    kept, seen = within > without, within + without > 0
    rest = np.flatnonzero(~seen & (hidden > through))  # shown by no view: they go with the nearest point that is
    if len(rest) and kept.any():
        from scipy.spatial import KDTree

        shown = np.flatnonzero(seen)
        kept[rest] = kept[shown[KDTree(points[shown]).query(points[rest])[1]]]
    return kept


def _fallen(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the points that fall into a picture, and their rows and columns in it."""
    pixels, depth = camera.project(points)
    ahead = np.flatnonzero(depth > 0.0)
    column, row = np.floor(pixels[ahead]).astype(np.int64).T
    falls = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return ahead[falls], row[falls], column[falls]


#: A node whose opacity across one voxel, or whose largest weight in any image, reaches this can be seen.
VISIBLE_OPACITY = 0.01

#: Nodes along the longest side of a grid that a sample of its visible nodes looks at, at least.
SAMPLED_SIDE = 128

#: Largest distance from a seed point to the nearest visible node, in voxels.
SEED_VOXELS = 4


def visible_nodes(field: DensityField, threshold: float | None = None) -> np.ndarray:
    """Positions (n, 3) float64, world units, of the nodes of a field that `visible_mask` has."""
    return _centers(field, np.argwhere(visible_mask(field, threshold)))


def some_visible_nodes(field: DensityField, count: int = 20_000) -> np.ndarray:
    """About so many of the nodes of a field that can be seen, evenly over it, (n, 3) float64, world units.
    The same for the same field, without a look at all of its nodes."""
    if not isinstance(field, VoxelField):
        points = visible_nodes(field)
    else:
        # a node in each block of so many along each axis; of grids of a few million nodes, all
        step = max(1, int(max(field.resolution) / SAMPLED_SIDE))
        links = field.host_links(step)
        cells = np.argwhere(links >= 0)
        rows = links[tuple(cells.T)]
        weights = field.weights
        densities = field.stored.density.numpy()[rows]
        if not np.isfinite(densities).all():
            raise InputError("a field with densities that are not finite has no visible nodes")
        seen = _visible(densities, None if weights is None else weights.numpy()[rows], field.voxel_size)
        points = _centers(field, step * cells[seen])
    chosen = np.random.default_rng(0).permutation(len(points))[:count]
    return points[np.sort(chosen)]


def visible_mask(field: DensityField, threshold: float | None = None) -> np.ndarray:
    """The nodes of a field that can be seen, (nx, ny, nz) bool, from a density per world unit on.
    threshold: None goes by the largest recorded weight, or by opacity across one voxel where none were recorded."""
    densities, voxel_size = node_grid(field)
    if threshold is not None:
        return densities >= checked_positive(threshold, "threshold, a density,")
    weights = getattr(field, "node_weights", lambda: None)()
    return _visible(densities, None if weights is None else np.asarray(weights), voxel_size)


def _visible(densities: np.ndarray, weights: np.ndarray | None, voxel_size: np.ndarray) -> np.ndarray:
    """Which nodes can be seen, by their densities and, where they were recorded, largest rendering weights."""
    if weights is not None:
        return (weights >= VISIBLE_OPACITY) & (densities > 0.0)
    return densities >= -np.log1p(-VISIBLE_OPACITY) / np.prod(voxel_size) ** (1.0 / 3.0)


def _occupancy(field: DensityField) -> str:
    """The fingerprint of the field of a selection: of which voxels hold values, or of its splats."""
    of_splats = splat_matter(field)
    if of_splats is not None:
        return of_splats.digest
    whole = root_field(field)
    return occupancy_digest(whole.host_links() >= 0 if isinstance(whole, VoxelField) else whole.node_densities() > 0.0)


def root_field(field: DensityField) -> DensityField:
    """The field that a selection, or a selection of a selection, was taken of; a field itself."""
    while isinstance(field, NodeSelection):
        field = field.field
    return field


def visible_rows(field: VoxelField) -> np.ndarray:
    """`visible_mask` of a VoxelField, row by row: (rows,) bool."""
    weights = None if field.weights is None else field.weights.numpy()
    return _visible(field.stored.density.numpy(), weights, field.voxel_size)


# Stands in for its field wherever densities are read: `Cage.from_field(selection)`, `extract_mesh(selection)`.
@dataclasses.dataclass(frozen=True)
class NodeSelection:
    """Nodes of a field.

    Args:
        field: The field, a VoxelField or the like; of splats their matter on a grid.
        mask: (nx, ny, nz) bool, the chosen nodes.
        notes: A line for each part that was left out.
        floor: Plane above which the chosen nodes lie, where they were cut from what they stand on; cages around them
            stay above it too. None: they were not cut.
    """

    field: DensityField
    mask: np.ndarray
    notes: tuple[str, ...] = ()
    floor: Plane | None = None

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
        return _centers(self.field, np.argwhere(self.mask))

    def __repr__(self) -> str:
        return f"NodeSelection({np.count_nonzero(self.mask)} of {self.mask.size} nodes)"

    def cut_out(self) -> Any:
        """The chosen part as a field of its own, with the background colour of the whole.

        Returns:
            A VoxelField of the same voxels, whose box ends a voxel beyond them. Or a SplatField of the splats whose
            centre, or most of whose matter, lies in the chosen cells; those that cannot be seen are left out.

        Raises:
            ValueError: If the selection is empty, or not of a VoxelField or a SplatField.
        """
        of_splats = splat_matter(self)
        if of_splats is not None:
            return of_splats.cut_out(self.mask)
        return cut_out(self._voxels("to be cut out"), self.mask)

    def preview(self, camera: Camera, *, color: ArrayLike = (0.1, 0.9, 0.2), strength: float = 0.55) -> np.ndarray:
        """A view of the field with the chosen part tinted where it is visible.

        Args:
            camera: The camera.
            color: (3,) the tint, in [0, 1].
            strength: Share of the tint in pixels that show the chosen part alone, 0 to 1.

        Returns:
            (h, w, 3) float32 in [0, 1].

        Raises:
            ValueError: If the selection is not of a VoxelField or a SplatField.
        """
        shown = splat_matter(self) or self._voxels("for a preview")
        return tinted_view(shown, self.mask, camera, color=color, strength=strength)

    def save(self, path: PathLike) -> None:
        """Write a selection file, whole or not at all. It can be loaded with this field alone.

        Args:
            path: The file: .npz holds packed bits, .json the lengths of runs.

        Raises:
            ValueError: For another ending.
        """
        floor = None if self.floor is None else (self.floor.normal, self.floor.offset)
        bounds, occupied = np.asarray(self.bounds, np.float64), _occupancy(self.field)
        save_selection(SelectionContents(bounds, occupied, self.mask, self.notes, floor), path)

    @classmethod
    def load(cls, path: PathLike, field: DensityField) -> NodeSelection:
        """Read a selection file.

        Args:
            path: The file.
            field: The field that it was made in, as it was or from its compact file.

        Returns:
            The selection. Of a SplatField its `field` is the matter in the box of the file.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: For a damaged file, a selection of another field, or an empty one.
        """
        held = load_selection(path)
        other = f"{path}: the selection is of another field"
        if hasattr(field, "matter"):
            if held.occupied != _occupancy(field):
                raise InputError(f"{other} than these splats: choose the object anew in this one")
            field = cast(Any, field).matter(held.bounds, max(held.mask.shape))
        size, own = "x".join(map(str, held.mask.shape)), "x".join(map(str, node_grid(field)[0].shape))
        if size != own:
            raise InputError(f"{other}, of {size} voxels: this one has {own}")
        bounds, voxel_size = np.asarray(field.bounds, np.float64), np.asarray(field.voxel_size)
        if not same_box(held.bounds, bounds, voxel_size):
            raise InputError(f"{other}, from {held.bounds[0].tolist()} to {held.bounds[1].tolist()}")
        if held.occupied != _occupancy(field):
            raise InputError(f"{other} in the same box: choose the object anew in this one")
        _require_some(held.mask, f"{path} holds no voxels")
        return cls(field, held.mask, held.notes, None if held.floor is None else Plane(*held.floor))

    def _voxels(self, what: str) -> VoxelField:
        whole = root_field(self)
        require_type(whole, VoxelField, f"a selection {what} must be of")
        return cast(VoxelField, whole)

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) densities, zero outside the selection."""
        return np.where(self.mask, self.field.node_densities(), np.float32(0.0))

    def node_weights(self) -> np.ndarray | None:
        """(nx, ny, nz) largest rendering weights, zero outside the selection; None where the field has none."""
        weights = getattr(self.field, "node_weights", lambda: None)()
        return None if weights is None else np.where(self.mask, weights, np.float32(0.0))


def select_nodes(
    field: DensityField,
    *,
    threshold: float | None = None,
    box: ArrayLike | None = None,
    sphere: ArrayLike | None = None,
    cage: ClosedMesh | None = None,
    cameras: Iterable[Camera] | None = None,
    masks: Iterable[ArrayLike] | None = None,
    depth: ArrayLike | None = None,
    seed: ArrayLike | None = None,
    reach: float | None = None,
    parts: int | None = None,
    floaters: float = 0.0,
) -> NodeSelection:
    """The visible nodes of a field that belong to an object: those that meet all given criteria.

    Connected means over faces, edges and corners of voxels.

    Args:
        field: A VoxelField, a NodeSelection or the like.
        threshold: Density from which a node counts as visible, per world unit. None goes by recorded weights or by
            opacity, as `warpcage.select.selection.visible_mask` does.
        box: (2, 3) corners of a box around the object, world units. None is no box.
        sphere: (4,) centre and radius of a sphere around the object, world units. None is no sphere.
        cage: A usable Cage around the object. None is no cage.
        cameras: Cameras of the masks, or of the views of `depth`.
        masks: One (h, w) mask per camera, of its size, the object where it is above half its largest value. Kept are
            nodes inside the mask in every picture that they fall into, and in at least one.
        depth: (2,) least and largest distance from the cameras, world units: kept is what their views, rendered from
            the field, show in this range more often than out of it, and what is hidden behind it. None is any.
        seed: (3,) a point in or on the object, world units: kept is what connects to the node nearest to it.
        reach: Largest distance from the seed, world units. None is no limit.
        parts: Number of connected parts to keep, the largest. None keeps all.
        floaters: Connected parts with fewer than this share of the largest part's nodes are dropped. 0 keeps all.

    Returns:
        The selection.

    Raises:
        ValueError: For values that make no sense, masks that do not fit their cameras, or where nothing is left.
    """
    mask = visible_mask(field, threshold)
    notes = _Notes(getattr(root_field(field), "node_name", "voxel"))
    _require_some(mask, "the field shows nothing")
    if box is not None:
        low, high = checked_bounds(box, "box")
        inside = _passing(field, mask, lambda points: ((points >= low) & (points <= high)).all(axis=1))
        mask = _kept(mask, inside, notes, "outside the box")
    if sphere is not None:
        mask = _kept(mask, _in_sphere(field, mask, sphere), notes, "outside the sphere")
    if cage is not None:
        require_type(cage, ClosedMesh, "to select what is inside takes")
        device = getattr(field, "device", "cpu")
        inside = _passing(field, mask, lambda points: inside_mesh(points, cage, device=device))
        mask = _kept(mask, inside, notes, "outside the cage")
    if cameras is not None and (isinstance(cameras, str) or not isinstance(cameras, Iterable)):
        raise InputError(f"cameras must be a list of cameras, got {type(cameras).__name__}")
    cameras = None if cameras is None else list(cameras)
    if (cameras is None) != (masks is None and depth is None):
        raise InputError("cameras and masks go together, one mask per camera; so do cameras and depth")
    if cameras is not None and masks is not None:
        shown = list(masks)
        inside = _passing(field, mask, lambda points: in_masks(points, cameras, shown))
        mask = _kept(mask, inside, notes, "outside the masks")
    if cameras is not None and depth is not None:
        where = "not shown by the views at these distances"
        mask = _kept(mask, _in_views(field, mask, cameras, depth), notes, where)
    if seed is not None:
        mask = _kept(mask, _grown(field, mask, seed, reach), notes, "not connected to the seed point")
    elif reach is not None:
        raise InputError("reach needs a seed point to reach from")
    if parts is not None:
        parts = checked_whole(parts, "parts", 1)
        labels, sizes, order = _parts(mask)
        mask = _kept(
            mask, np.isin(labels, order[:parts]), notes, f"in {counted(max(len(order) - parts, 0), 'smaller part')}"
        )
    floaters = checked_number(floaters, "floaters")
    if not 0.0 <= floaters < 1.0:
        raise InputError(f"floaters must be a share of the largest part, 0 to below 1, got {floaters:g}")
    if floaters > 0.0:
        labels, sizes, order = _parts(mask)
        large = order[sizes[order] >= floaters * sizes[order[0]]]
        most = sizes[order[len(large) :]].max(initial=0)
        where = f"in {len(order) - len(large)} floaters of up to {counted(most, notes.node)}"
        mask = _kept(mask, np.isin(labels, large), notes, where)
    return NodeSelection(field, mask, tuple(notes), getattr(field, "floor", None))


class _Notes(list[str]):
    """Notes of what was left out; node: what messages call a node, a voxel, or a cell of a grid of splats."""

    def __init__(self, node: str):
        super().__init__()
        self.node = node


def _kept(mask: np.ndarray, keep: np.ndarray, notes: _Notes, where: str) -> np.ndarray:
    """The nodes that are left, and a note of how many are not; refused where none is left."""
    left = mask & keep
    _require_some(left, f"all {np.count_nonzero(mask)} visible {notes.node}s are {where}")
    dropped = np.count_nonzero(mask) - np.count_nonzero(left)
    if dropped:
        notes.append(f"left out {counted(dropped, f'visible {notes.node}')} {where}")
    return left


def _require_some(mask: np.ndarray, complaint: str) -> None:
    if not mask.any():
        raise InputError(f"nothing is selected: {complaint}")


def _centers(field: DensityField, cells: np.ndarray) -> np.ndarray:
    """(n, 3) world positions of nodes (n, 3)."""
    return np.asarray(field.bounds, dtype=np.float64)[0] + (cells + 0.5) * np.asarray(field.voxel_size)


def _passing(field: DensityField, mask: np.ndarray, test: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The nodes of a mask whose world positions pass a test, which takes (n, 3) and returns (n,) bool."""
    cells = np.argwhere(mask)
    result = np.zeros_like(mask)
    result[tuple(cells.T)] = test(_centers(field, cells))
    return result


def _in_sphere(field: DensityField, mask: np.ndarray, sphere: ArrayLike) -> np.ndarray:
    values = np.asarray(sphere, np.float64) if np.shape(sphere) == (4,) else np.full(4, np.nan)
    if not (np.isfinite(values).all() and values[3] > 0.0):
        raise InputError(f"sphere must be a centre and a positive radius, four numbers, got {shown(sphere)}")
    return _passing(field, mask, lambda points: np.linalg.norm(points - values[:3], axis=1) <= values[3])


def _in_views(field: DensityField, mask: np.ndarray, cameras: list[Camera], depth: ArrayLike) -> np.ndarray:
    whole = root_field(field)
    if not hasattr(whole, "render"):
        raise InputError("depth needs a field that can be rendered")
    return _passing(field, mask, lambda points: in_depths(points, cast(VoxelField, whole), cameras, depth))


def _grown(field: DensityField, mask: np.ndarray, seed: ArrayLike, reach: float | None) -> np.ndarray:
    """The nodes that connect to the one nearest to a seed point, no farther from it than `reach`."""
    start = checked_vector(seed, "seed")
    if reach is not None:
        reach = checked_positive(reach, "reach")
    cells = np.argwhere(mask)
    distance = np.linalg.norm(_centers(field, cells) - start, axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > SEED_VOXELS * float(np.max(field.voxel_size)):
        raise InputError(
            f"nothing visible is near the seed point {start.tolist()}: the nearest voxel is "
            f"{distance[nearest]:.4g} away, more than {SEED_VOXELS} voxels"
        )
    if reach is not None:
        mask = mask.copy()
        mask[tuple(cells[distance > max(reach, distance[nearest])].T)] = False
    labels, _, _ = _parts(mask)
    return labels == labels[tuple(cells[nearest])]


def _parts(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Part number of each node (0 for none), number of nodes of each part, part numbers from the largest down."""
    import skimage.measure

    labels = np.asarray(skimage.measure.label(mask, connectivity=3))
    sizes = np.bincount(labels.reshape(-1))
    sizes[0] = 0
    order = np.argsort(-sizes, kind="stable")
    return labels, sizes, order[sizes[order] > 0]
