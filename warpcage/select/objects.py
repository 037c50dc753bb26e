"""Objects of a scene chosen by a click, a point or pixels; of splats on grids that become finer around them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_bounds, checked_number, checked_vector, require_type, shown
from ..core.names import PLANES, checked_choice
from ..core.reports import Progress, report_progress, reports_progress
from ..errors import InputError
from ..field.surface import DensityField, node_grid, surface_density
from ..field.surroundings import OuterField
from ..mesh.mesh import ClosedMesh
from ..view.camera import Camera
from .planes import Plane, find_planes, plane_below, plane_through
from .selection import SEED_VOXELS, NodeSelection, _centers, root_field, select_nodes

if TYPE_CHECKING:
    from ..field.voxel_field import VoxelField


#: Cells along the longest side of a grid, at most and at least.
MAX_CELLS, MIN_CELLS = 128, 32

#: What is looked at around an object, on each side, as a share of its longest side: planes go on around what stands on
#: them over twice its area.
AROUND = 0.75

#: A grid is done where a finer one would be longer than this share of it.
NEAR_ENOUGH = 0.85

#: Grids that are tried, and the share of one that the next has around a click on nothing or on a plane.
GRIDS, CLOSER = 9, 0.5

#: How much larger the next window about a click is where an object does not end in the one before.
WIDER = 1.6

#: What is found only after a click that seemed to be on nothing or on a plane is an object from so many cells along its
#: shortest side on, and not the roughness of the plane.
MIN_SIDE = 4


def is_splats(field: object) -> bool:
    """Whether a field is of splats, which can be looked at on any grid."""
    return hasattr(field, "matter")


def region_box(box: ArrayLike | None, sphere: ArrayLike | None, cage: Any) -> np.ndarray | None:
    """The box (2, 3) of a region, which may be wrong where what is given makes no sense; None of no region."""
    boxes = [] if box is None else [checked_bounds(box, "box")]
    if sphere is not None and np.shape(sphere) == (4,):
        ball = np.asarray(sphere, np.float64)
        boxes.append(np.stack([ball[:3] - ball[3], ball[:3] + ball[3]]))
    if hasattr(cage, "vertices"):
        boxes.append(np.stack([cage.vertices.min(axis=0), cage.vertices.max(axis=0)]))
    return _common(boxes) if boxes else None


def matter_around(field: Any, region: np.ndarray) -> Any:
    """The matter (SplatDensity) of a field of splats on a grid about a region (2, 3)."""
    window = _clipped(_around(region), field)
    return field.matter(window, _cells(field, window))


def choose_closer(
    field: Any, choose: Callable[[DensityField], NodeSelection], clicks: np.ndarray | None, region: np.ndarray | None
) -> NodeSelection:
    """What `choose` takes of a field of splats, on the finest grid around it that shows it.
    clicks (k, 3) are on it, or None; region (2, 3) holds it, or None."""
    window = _clipped(_around(region), field) if region is not None else np.array(field.shown_bounds)
    near = None
    if region is None and clicks is not None:
        window = np.stack([np.minimum(window[0], clicks.min(axis=0)), np.maximum(window[1], clicks.max(axis=0))])
        near = _near(field, choose, clicks, window)
        window = window if near is None else near[0]
    found: NodeSelection | None = None
    failed: ValueError | None = None
    for _ in range(GRIDS):
        seen = field.matter(window, _cells(field, window)) if near is None else near[1]
        try:
            chosen = choose(seen) if near is None else near[2]
            near = None
            if failed is not None and found is None and _side(chosen) < MIN_SIDE:
                raise failed
        except ValueError as error:
            failed = failed or error
            if found is not None or clicks is None or _longest(window) <= MIN_CELLS * field.finest_cell(window):
                break
            window = _shrunk(window, clicks)
            continue
        found = chosen
        points = chosen.points
        closer = _clipped(_around(np.stack([points.min(axis=0), points.max(axis=0)]), seen.voxel_size), field)
        if _longest(closer) > NEAR_ENOUGH * _longest(window) and not _is_cut(chosen, field):
            break
        if _longest(closer) <= MIN_CELLS * field.finest_cell(window) or np.allclose(closer, window):
            break
        window = closer
    if found is None:
        assert failed is not None
        raise failed
    return found


def _near(
    field: Any, choose: Callable[[DensityField], NodeSelection], clicks: np.ndarray, whole: np.ndarray
) -> tuple[np.ndarray, DensityField, NodeSelection] | None:
    """The smallest window about clicks in which what is chosen ends, its matter, and what is chosen; None in none."""
    # from near to far: in a whole place far walls are planes too, and all that has few cells hangs together
    middle = 0.5 * (clicks.min(axis=0) + clicks.max(axis=0))
    half = float(np.ptp(clicks, axis=0).max()) + 2.0 * _longest(whole) / MAX_CELLS
    while 2.0 * half < _longest(whole):
        window = _clipped(np.stack([middle - half, middle + half]), field)
        half *= WIDER
        if _longest(window) < MIN_CELLS * field.finest_cell(window):
            continue
        seen = field.matter(window, _cells(field, window))
        try:
            chosen = choose(seen)
        except ValueError:
            continue  # nothing there, or no plane yet
        if _side(chosen) >= MIN_SIDE and not _is_cut(chosen, field):
            return window, seen, chosen
    return None


def _cells(field: Any, window: np.ndarray) -> int:
    """Cells along the longest side of a window, no smaller than its splats allow."""
    finest = field.finest_cell(window)
    return int(np.clip(_longest(window) / finest, MIN_CELLS, MAX_CELLS)) if finest > 0.0 else MAX_CELLS


def _longest(box: np.ndarray) -> float:
    return float((box[1] - box[0]).max())


def _side(chosen: NodeSelection) -> int:
    """Cells along the shortest side of what is chosen."""
    return int(np.ptp(np.argwhere(chosen.mask), axis=0).min()) + 1


def _around(box: np.ndarray, least: ArrayLike = 0.0) -> np.ndarray:
    """A box with what is around it; least: its longest side, at least."""
    side = max(_longest(box), float(np.max(least)))
    return np.stack([box[0] - AROUND * side, box[1] + AROUND * side])


def _common(boxes: list[np.ndarray]) -> np.ndarray:
    """What boxes share; the first where they share nothing."""
    both = np.stack([np.max([each[0] for each in boxes], axis=0), np.min([each[1] for each in boxes], axis=0)])
    return both if (both[1] > both[0]).all() else boxes[0]


def _clipped(box: np.ndarray, field: Any) -> np.ndarray:
    return _common([np.asarray(field.bounds, np.float64), box])


def _shrunk(window: np.ndarray, clicks: np.ndarray) -> np.ndarray:
    """A window of half the size about clicks, in which they all are."""
    half = 0.5 * CLOSER * (window[1] - window[0])
    return np.stack([clicks.min(axis=0) - half, clicks.max(axis=0) + half])


def _is_cut(chosen: NodeSelection, field: Any) -> bool:
    """Whether what is chosen reaches a side of its grid beyond which the field goes on."""
    sides = [np.take(chosen.mask, end, axis=axis).any() for end in (0, -1) for axis in range(3)]
    beyond = [*(chosen.bounds[0] > field.bounds[0]), *(chosen.bounds[1] < field.bounds[1])]
    return any(side and more for side, more in zip(sides, beyond, strict=True))


#: A pixel shows the place where the light that is left falls to this share; faint floaters before it are passed.
PICKED_TRANSMITTANCE = 0.5


def pick_point(field: VoxelField, camera: Camera, pixel: ArrayLike) -> np.ndarray:
    """The place (3,) float64, world units, that a pixel shows: where half of the light through its middle is gone.
    pixel: column and row, whole numbers from 0 at the top left."""
    require_type(camera, Camera, "a click needs")
    place = np.asarray(pixel)
    whole = place.shape == (2,) and np.issubdtype(place.dtype, np.number) and bool((place == np.floor(place)).all())
    if not whole:
        raise InputError(f"a pixel is a column and a row, two whole numbers, got {shown(pixel)}")
    column, row = (int(each) for each in place)
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise InputError(
            f"pixel {column} {row} is outside the picture of {camera.width}x{camera.height}: columns go from 0 to "
            f"{camera.width - 1}, rows from 0 to {camera.height - 1}"
        )
    in_camera = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
    direction = camera.rotation @ (in_camera / np.linalg.norm(in_camera))
    nothing = f"the click at pixel {column} {row} is on nothing: the field is not half opaque there"
    if hasattr(field, "distance_seen"):  # splats
        far = cast(Any, field).distance_seen(camera.center, direction, spread=1.0 / camera.fx)
        if not np.isfinite(far):
            raise InputError(nothing)
        return camera.center + far * direction
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (field.bounds - camera.center) / direction
    along = np.where(np.isnan(ends), [[-np.inf], [np.inf]], np.sort(ends, axis=0))
    near, far = max(float(along[0].max()), 0.0), float(along[1].min())
    if not near < far:
        raise InputError(nothing)
    distance = near + field.step * (np.arange(int(np.ceil((far - near) / field.step))) + 0.5)
    points = camera.center + distance[:, None] * direction
    _, density = field.sample(points, np.broadcast_to(direction, points.shape))
    depth = np.cumsum(np.asarray(density, np.float64)) * field.step
    there = int(np.searchsorted(depth, -np.log(PICKED_TRANSMITTANCE)))
    if there == len(depth):
        raise InputError(nothing)
    return points[there]


#: What can be seen of an object reaches so many voxels beyond what is dense enough to be its surface, and such a share
#: of its longest side: fur and dark cloth of a fine field are many voxels deep.
FRINGE_VOXELS, FRINGE_SHARE = 2, 0.02

#: From so many dense nodes on at a side of the field's box an object may go on beyond it.
AT_SIDE = 4

#: Steps of choosing an object on one grid, as progress counts them.
STEPS = 4

#: What messages call each kind of plane.
PLANE_NAMES = {"ground": "ground plane", "wall": "wall", "any": "plane"}


@reports_progress
def select_object(
    field: DensityField,
    *,
    point: ArrayLike | None = None,
    pixel: ArrayLike | None = None,
    camera: Camera | None = None,
    box: ArrayLike | None = None,
    sphere: ArrayLike | None = None,
    cage: ClosedMesh | None = None,
    cameras: Iterable[Camera] | None = None,
    masks: Iterable[ArrayLike] | None = None,
    depth: ArrayLike | None = None,
    plane: str | Plane | None = "ground",
    plane_at: ArrayLike | None = None,
    up: ArrayLike | None = None,
    clearance: float | None = None,
    parts: int | None = None,
    floaters: float = 0.0,
    progress: bool | Progress = False,
) -> NodeSelection:
    """An object of a scene without what it stands on: no masks are needed.

    A click, a region or both choose the object. The plane that it stands on is found in the whole field
    (`find_planes`): the nearest one below that extends around its foot. Matter up to `clearance` above that plane
    belongs to the plane. A click keeps what connects to it through faces of voxels that are dense enough for a surface
    (`warpcage.field.surface.surface_density`), so that haze connects nothing, and what else is visible within two
    voxels of that, or a fiftieth of its longest side.

    The matter of a SplatField is sampled on grids that become finer around the object, so that a small object in a
    large scene has as many cells as one that fills its field.

    Example::

        cup = select_object(field, point=(0.2, 0.1, 0.4))
        cage = Cage.from_field(cup, 80)

    Args:
        field: A VoxelField, a SplatField, a NodeSelection or the like.
        point: (3,) or (k, 3) places on the object, world units. None is no click.
        pixel: (2,) or (k, 2) column and row of pixels of `camera` that show the object. None is no click.
        camera: The camera of `pixel`.
        box: (2, 3) corners of a box around the object, world units; see `select_nodes` for it and the next five.
        sphere: (4,) centre and radius of a sphere around it, world units.
        cage: A Cage around it.
        cameras: Cameras of `masks` and `depth`.
        masks: One (h, w) mask per camera.
        depth: (2,) least and largest distance from the cameras, world units.
        plane: What it stands on, relative to `up`: "ground" is a level plane, "wall" an upright one, "any" either; or
            a Plane; or None for nothing.
        plane_at: (3,) a point on the plane, world units, to choose among several. None chooses by the object.
        up: (3,) up direction of the world. None is the field's own.
        clearance: Distance above the plane at which the object begins, world units. None is 2.5 standard
            deviations of the heights of the plane's points and one voxel.
        parts: Number of connected parts to keep, the largest. None keeps all.
        floaters: Connected parts with fewer than this share of the largest part's nodes are dropped. 0 keeps all.
        progress: True shows bars on stderr. A function is called with (done, total, message), in steps
            on each grid, and cancels by returning False.

    Returns:
        The selection. Its `floor` is the plane that it was cut at; its `notes` name the sides of the field's box at
        which it may go on into the outer field, which no cage moves.

    Raises:
        ValueError: In one line: a click on nothing or on the plane, no such plane, nothing left, or values that make no
            sense.
        Cancelled: Where `progress` returned False.
    """
    clicks = _clicks(field, point, pixel, camera)
    if clearance is not None:
        clearance = checked_number(clearance, "clearance")
        if clearance < 0.0:
            raise InputError(f"clearance must not be negative, got {clearance}")
        if plane is None:
            raise InputError("clearance is the distance from a plane: choose one")
    if plane is None and plane_at is not None:
        raise InputError("plane_at is a point on the plane: choose 'ground', 'wall' or 'any'")
    cameras, masks = _held(cameras), _held(masks)  # several grids may ask for them
    all_of: dict[str, Any] = {"box": box, "sphere": sphere, "cage": cage}
    all_of |= {"cameras": cameras, "masks": masks, "depth": depth}
    given = {name: value for name, value in all_of.items() if value is not None}

    def choose(seen: DensityField) -> NodeSelection:
        report_progress(progress, 0, STEPS, "object: what is in the region")
        chosen = _object_in(select_nodes(seen, **given), clicks, plane, plane_at, up, clearance, progress)
        if parts is None and floaters == 0.0:
            return chosen
        kept = select_nodes(chosen, parts=parts, floaters=floaters)
        return dataclasses.replace(chosen, mask=kept.mask, notes=(*chosen.notes, *kept.notes))

    return choose_closer(field, choose, clicks, region_box(box, sphere, cage)) if is_splats(field) else choose(field)


def _held(values: Any) -> Any:
    """What may be read only once as a list; what is none stays, for the checks."""
    return list(values) if isinstance(values, Iterable) and not isinstance(values, str) else values


def _object_in(
    region: NodeSelection, clicks, plane, plane_at, up, clearance: float | None, progress: bool | Progress
) -> NodeSelection:
    """The object in what is visible of a region of a field, by clicks (k, 3) or all of it, above its plane."""
    field = region.field
    report_progress(progress, 1, STEPS, "object: what is dense")
    matter = _Matter(region)
    if clicks is not None:
        matter.connected(matter.above(None), clicks)
    notes = list(region.notes)
    floor = None
    report_progress(progress, 2, STEPS, "object: what it stands on")
    if plane is not None:
        base = plane if isinstance(plane, Plane) else _support(field, matter, clicks, plane, plane_at, up)
        above = base.clearance(field.voxel_size) if clearance is None else clearance
        for click in () if clicks is None else clicks:
            if base.heights(click) <= above:
                raise InputError(_on_plane(click, base, above, plane))
        floor = Plane(base.normal, base.offset + above)
        voxels = above / float(np.max(field.voxel_size))
        node = getattr(root_field(field), "node_name", "voxel")
        notes.append(
            f"cut {above:.4g} ({voxels:.1f} {node}s) above the {_plane_text(plane)} through "
            f"{(base.normal * base.offset).round(4).tolist()}, normal {base.normal.round(3).tolist()}"
            + (f", {100 * base.share:.0f} % of the surface" if len(base.points) else "")
        )
    report_progress(progress, 3, STEPS, "object: what is connected")
    mask = matter.above(floor)
    if clicks is not None:
        mask = matter.connected(mask, clicks)
    if not mask.any():
        where = "" if floor is None else " above the plane"
        raise InputError(f"nothing is selected: nothing dense enough for a surface is left{where}")
    notes += _cut_off(field, mask)
    mask = matter.with_fringe(mask, floor)
    report_progress(progress, STEPS, STEPS, "object: its fringe")
    return NodeSelection(region.field, mask, tuple(notes), floor)


class _Matter:
    """What can be seen of a region, and which of it is dense enough to be a surface."""

    def __init__(self, region: NodeSelection):
        self.region, self.visible = region, region.mask
        densities, self._voxel = node_grid(root_field(region))
        self._solid = self.visible & (densities >= surface_density(densities, self._voxel))
        self._cells = np.argwhere(self._solid)
        self._places = _centers(region, self._cells)

    def places(self, mask: np.ndarray) -> np.ndarray:
        """(n, 3) world positions of the nodes of a mask."""
        return _centers(self.region, np.argwhere(mask))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which points (n, 3), positions of nodes, are visible and in the region, (n,) bool."""
        cells = np.floor((points - np.asarray(self.region.bounds)[0]) / self._voxel).astype(int)
        return self.visible[tuple(np.clip(cells, 0, np.array(self.visible.shape) - 1).T)]

    def above(self, floor: Plane | None) -> np.ndarray:
        """(nx, ny, nz) bool, what is dense above a plane."""
        if floor is None:
            return self._solid
        mask = np.zeros_like(self._solid)
        mask[tuple(self._cells[floor.heights(self._places) > 0.0].T)] = True
        return mask

    def connected(self, mask: np.ndarray, clicks: np.ndarray) -> np.ndarray:
        """The parts of a mask that clicks (k, 3) are on or next to."""
        import skimage.measure

        cells = np.argwhere(mask)
        places = _centers(self.region, cells)
        labels = np.asarray(skimage.measure.label(mask, connectivity=1))
        chosen = set()
        for click in clicks:
            distance = np.linalg.norm(places - click, axis=1)
            nearest = int(np.argmin(distance)) if len(cells) else -1
            if nearest < 0 or distance[nearest] > SEED_VOXELS * float(self._voxel.max()):
                raise InputError(
                    f"the click at {click.round(4).tolist()} is on nothing: nothing dense enough for a surface "
                    f"lies within {SEED_VOXELS} voxels of it"
                )
            chosen.add(int(labels[tuple(cells[nearest])]))
        return np.isin(labels, sorted(chosen))

    def with_fringe(self, mask: np.ndarray, floor: Plane | None) -> np.ndarray:
        """A mask with what else is visible within a few voxels of it, above the plane, and nearer to no other part."""
        from scipy.ndimage import binary_dilation

        cells = np.argwhere(mask)
        steps = max(FRINGE_VOXELS, round(FRINGE_SHARE * int(np.ptp(cells, axis=0).max() + 1)))
        low = np.maximum(cells.min(axis=0) - steps, 0)
        block = tuple(slice(a, b + steps + 1) for a, b in zip(low, cells.max(axis=0), strict=True))
        free = self.visible[block] & ~self._solid[block]
        if floor is not None:
            halo = np.argwhere(free)
            under = floor.heights(_centers(self.region, halo + low)) <= 0.0
            free[tuple(halo[under].T)] = False
        own, other = mask[block], self._solid[block] & ~mask[block]
        cube = np.ones((3, 3, 3), bool)
        for _ in range(steps):
            grown = np.asarray(binary_dilation(own, cube), bool) & free & ~other
            other = other | (np.asarray(binary_dilation(other, cube), bool) & free & ~own)
            own = own | (grown & ~other)
        result = mask.copy()
        result[block] |= own
        return result


def _cut_off(field: DensityField, mask: np.ndarray) -> list[str]:
    """Notes of the sides of the box at which an object goes on into what is around the field, where there is some."""
    if not isinstance(getattr(root_field(field), "background_model", None), OuterField):
        return []
    ends = [(sign + name, axis, end) for axis, name in enumerate("xyz") for sign, end in (("-", 0), ("+", -1))]
    sides = [
        f"{name} ({name[1]} = {field.bounds[end, axis]:.4g})"
        for name, axis, end in ends
        if np.count_nonzero(np.take(mask, end, axis=axis)) >= AT_SIDE
    ]
    if not sides:
        return []
    where = f"side{'s' if len(sides) > 1 else ''} {', '.join(sides)}"
    return [f"the object reaches the {where} of the field's box and may be cut off there: fit with larger --bounds"]


def _clicks(field: DensityField, point, pixel, camera) -> np.ndarray | None:
    """(k, 3) places of clicks, None where there are none."""
    if (pixel is None) != (camera is None):
        raise InputError("pixel and camera go together: a click in the picture of a camera")
    clicks = []
    if point is not None:
        rows = [point] if np.ndim(point) < 2 else list(np.asarray(point))
        clicks += [checked_vector(row, "point") for row in rows]
    if pixel is not None and camera is not None:
        whole = root_field(field)
        whole = getattr(whole, "field", whole)  # the splats, of densities on a grid of theirs
        if not (hasattr(whole, "sample") or is_splats(whole)):
            raise InputError("a click at a pixel needs a field that can be sampled")
        rows = [pixel] if np.ndim(pixel) < 2 else list(np.asarray(pixel))
        clicks += [pick_point(cast("VoxelField", whole), camera, row) for row in rows]
    if (point is not None or pixel is not None) and not clicks:
        raise InputError("there is no click: give a point or a pixel")
    return np.stack(clicks) if clicks else None


def _support(field, matter: _Matter, clicks, kind: str, plane_at, up) -> Plane:
    """The plane of a kind that the clicked matter, or all in the region, stands on."""
    checked_choice(kind, "plane", PLANES)
    name, voxel = PLANE_NAMES[kind], field.voxel_size
    whole = root_field(field)
    planes = find_planes(whole, kind, up=up)
    if not planes:
        raise InputError(f"no {name} is found in the field: {_other_planes(kind)}")
    if plane_at is not None:
        place = checked_vector(plane_at, "plane_at")
        far = [abs(float(plane.heights(place))) for plane in planes]
        nearest = int(np.argmin(far))
        room = max(planes[nearest].clearance(voxel), SEED_VOXELS * float(np.max(voxel)))
        if far[nearest] > room:
            raise InputError(
                f"no {name} passes near {place.tolist()}: the nearest of {len(planes)} is {far[nearest]:.4g} away"
            )
        return planes[nearest]

    if clicks is None:
        places = matter.places(matter.above(None))
        if not len(places):
            raise InputError("nothing is selected: nothing in the region is dense enough for a surface")
        found = plane_through(planes, places, voxel, matter.holds)
        if found is None:
            raise InputError(f"the selection stands on no {name}: {_other_planes(kind)}")
        return found

    def grown(plane: Plane) -> np.ndarray:
        mask = matter.above(Plane(plane.normal, plane.offset + plane.clearance(voxel)))
        return matter.places(matter.connected(mask, clicks))

    found = plane_below(planes, clicks, voxel, grown)
    if found is not None:
        return found
    for plane in planes:
        if abs(float(np.median(plane.heights(clicks)))) <= plane.clearance(voxel):
            raise InputError(_on_plane(clicks[0], plane, plane.clearance(voxel), kind))
    raise InputError(
        f"no {name} of the field's {len(planes)} lies below the click at {clicks[0].round(4).tolist()}: "
        f"{_other_planes(kind)}"
    )


def _plane_text(plane: str | Plane) -> str:
    return PLANE_NAMES[plane] if isinstance(plane, str) else "plane"


def _on_plane(click: np.ndarray, plane: Plane, clearance: float, kind: str | Plane) -> str:
    return (
        f"the click at {click.round(4).tolist()} is on the {_plane_text(kind)}, not on an object: it lies "
        f"{float(plane.heights(click)):.4g} above it, and what stands on it begins at {clearance:.4g}"
    )


def _other_planes(kind: str) -> str:
    others = [name for name in PLANES if name != kind]
    return f"choose another kind ({' or '.join(others)}), or none for an object that stands on nothing"
