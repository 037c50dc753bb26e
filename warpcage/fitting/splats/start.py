"""Where a fit of splats begins: at points of the capture, inside the silhouettes, or at places that views share."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from ...core.devices import resolve_device
from ...core.threads import cpu_threads
from ...errors import InputError
from ...scene.box import axes_meeting, center_ahead, scene_box
from ...scene.scene import Scene
from ...view.camera import Camera
from ...view.pictures import shrink_weights
from ..silhouettes import Silhouettes, possible_voxels

#: Fewer points of a capture say too little about it.
MIN_POINTS = 100

#: Most places that are drawn where there are no points, as 3DGS does (Kerbl et al. 2023).
MAX_PLACES = 100_000

#: Where splats may begin: "auto" takes points where there are enough, the inside of silhouettes, or a fit of voxels.
STARTS = ("auto", "points", "voxels", "random")

#: Points farther from what the cameras look at than this, in units of `scene_units`, are mistakes of a reconstruction.
FARTHEST = 1000.0

#: Views that colours are taken from, and that silhouettes are carved by; evenly over all.
COLOR_VIEWS, CARVING_VIEWS = 16, 64

#: Points are of the object where at least this share of the views that have them in the picture show it there.
OBJECT_SHARE = 0.5

#: Alpha from which a pixel has a colour of its own.
OPAQUE = 0.5

#: Voxels along the longest side of the object's box, and the share of the views that must see one.
RESOLUTION, VIEW_SHARE = 128, 0.1

#: Neighbours that say how large a splat is, and the least size over the median one: points may lie on each other.
NEIGHBORS, MIN_SIZE = 3, 1e-3

#: Nearest and farthest place that is drawn in a view, in units of `scene_units`.
NEAR, FAR = 0.1, 10.0

#: Views that must have a place in their picture; how many look for each; places tried for each that is wanted.
VIEWS, LOOKING_VIEWS, TRIES = 3, 64, 16

#: Least `extent` of a scene: a single camera has none, and the rates of a fit are multiples of it.
MIN_EXTENT = 0.1

#: Where pictures show what has no point: cells along their longer side in which points are looked for, how many
#: points look, places over points, and how far these are, in units of `scene_units`.
GAP_CELLS, GAP_POINTS, GAP_SHARE, GAP_DISTANCE = 24, 50_000, 0.2, 20.0

#: Quick fits of voxels: longest side of their pictures, options, and views below which they show too little.
QUICK_SIDE, QUICK_SIDE_CPU, MIN_VIEWS = 400, 100, 8
QUICK_FIT = {"epochs": 2.0, "max_resolution": 192, "max_outer_resolution": 192}

#: Mean of the cameras' axes, over their length, from which they look the same way.
SAME_WAY = 0.9


@dataclasses.dataclass
class Start:
    """Splats before the first step."""

    centers: np.ndarray  # (n, 3) float64, world units
    colors: np.ndarray  # (n, 3) float32 in [0, 1]
    log_scales: np.ndarray  # (n,) float32, logarithms of the distance to their neighbours, world units
    source: str  # for people: "206,613 points of the capture"


def fitted_scene(scene: Scene) -> Scene:
    """What splats are fitted to: whole pictures, where masks split them and nothing is lost."""
    if scene.surroundings is None:
        return scene
    return dataclasses.replace(scene, images=scene.whole, alphas=None, surroundings=None)


def scene_units(scene: Scene) -> tuple[np.ndarray, float, float]:
    """The point (3,) that cameras look at; their median distance from it, the unit of a fit; and 1.1 times the greatest
    distance of a camera from their mean, in that unit. All finite, unit and extent above 0."""
    # As gsplat normalises a scene (examples/datasets/normalize.py): rates and noise of MCMC are not free of units.
    centers = np.stack([camera.center for camera in scene.cameras])
    forward = np.mean([camera.rotation[:, 2] for camera in scene.cameras], axis=0)
    focus = axes_meeting(scene.cameras)
    if focus is not None and np.linalg.norm(forward) > SAME_WAY:  # nearly parallel axes may meet behind the cameras
        ahead = sum((focus - camera.center) @ camera.rotation[:, 2] > 0 for camera in scene.cameras)
        focus = focus if 2 * ahead > len(centers) else None
    if focus is None:
        focus = center_ahead(scene.cameras) if scene.bounds is None else scene.bounds.mean(axis=0)
    unit = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    if not unit > 1e-9 * max(1.0, float(np.abs(focus).max())):  # all at one place, turning about it
        unit = spread if spread > 0 else 1.0
    return focus, unit, max(1.1 * spread / unit, MIN_EXTENT)


def starting_splats(scene: Scene, *, most: int, seed: int, device: wp.DeviceLike = None, kind: str = "auto") -> Start:
    """At most `most` splats to begin a fit with, on a CPU the same for a seed; kind: of STARTS. ValueError where the
    silhouettes have no common inside, and for points where there are none."""
    random = np.random.default_rng(seed)
    found = _captured_points(scene, most, random) if kind in ("auto", "points") else None
    if found is None and kind == "points":
        raise InputError(f"the scene has fewer than {MIN_POINTS} points to begin with")
    has_points = found is not None
    if found is None:
        count = min(most, MAX_PLACES)
        if kind == "voxels" or (kind == "auto" and scene.alphas is None and len(scene) >= MIN_VIEWS):
            found = _surface_places(scene, count, random, device)
        else:
            if scene.alphas is not None:
                centers, source = _places_inside(scene, count, random, device), "inside the silhouettes"
            else:
                centers, source = _places_seen(scene, count, random), "that several views see"
            found = centers, _pictured(scene, centers)[0], f"{len(centers):,} random places {source}"
    centers, colors, source = found
    first = Start(centers, colors.astype(np.float32, copy=False), _log_scales(centers, scene), source)
    completes = has_points and kind == "auto" and scene.alphas is None
    return _with_gaps(scene, first, most, random) if completes else first


def _with_gaps(scene: Scene, first: Start, most: int, random: np.random.Generator) -> Start:
    """Points and, in the cells of pictures that show none of them, places far behind all of them."""
    # Reconstructions have no points on the sky. Splats that grow from others alone close such holes late, by large ones
    # near the cameras. Nearer places would do so too, in front of plain walls: they cost captures indoors 0.5 to 3 dB.
    looking = first.centers[np.sort(random.permutation(len(first.centers))[:GAP_POINTS])]
    views = [_gap_rays(scene, view, looking, random) for view in range(len(scene))]
    origins, rays, colors, widths = (np.concatenate(each) for each in zip(*views, strict=True))
    count = min(len(rays), int(GAP_SHARE * len(first.centers)), most - len(first.centers))
    if count <= 0:
        return first
    chosen = np.sort(random.choice(len(rays), count, replace=False))
    _, unit, _ = scene_units(scene)
    distance = GAP_DISTANCE * unit
    return Start(
        np.concatenate([first.centers, origins[chosen] + distance * rays[chosen]]),
        np.concatenate([first.colors, colors[chosen]]),
        np.concatenate([first.log_scales, np.log(widths[chosen] * distance).astype(np.float32)]),
        f"{first.source} and {count:,} far places where pictures have none",
    )


def _gap_rays(scene: Scene, view: int, points: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Of each cell of a picture that has no point (n, 3) in it or beside it, a ray: origins and directions (m, 3),
    colours (m, 3), widths of the cells at distance 1 (m,)."""
    from scipy.ndimage import binary_dilation

    camera, image = scene.cameras[view], scene.images[view]
    side = max(camera.width, camera.height) / min(GAP_CELLS, max(camera.width, camera.height))
    _, rows, columns = _pixels(camera, points)
    taken = np.zeros((math.ceil(camera.height / side), math.ceil(camera.width / side)), bool)
    taken[(rows / side).astype(int), (columns / side).astype(int)] = True
    cells = np.argwhere(np.logical_not(binary_dilation(taken, np.ones((3, 3), bool))))
    corner = (cells[:, ::-1] + random.random((len(cells), 2))) * side
    x, y = np.minimum(corner, np.array([camera.width, camera.height]) - 0.5).T
    if scene.weights is not None:
        counts = scene.weights[view, y.astype(int), x.astype(int)] > 0.0
        x, y = x[counts], y[counts]
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
    rays = local @ camera.rotation.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.center, rays.shape)
    return origins, rays, image[y.astype(int), x.astype(int)], np.full(len(rays), side / camera.fx)


def _captured_points(scene: Scene, most: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str] | None:
    """Points of the capture, (n, 3) each of places and colours, and what they are; None where there are too few."""
    if scene.points is None or len(scene.points) < MIN_POINTS:
        return None
    focus, unit, _ = scene_units(scene)
    kept = np.flatnonzero(np.linalg.norm(scene.points - focus, axis=1) <= FARTHEST * unit)
    colors = None if scene.point_colors is None else scene.point_colors[kept]
    if scene.alphas is not None:  # nothing is to be fitted around the object
        pictured, share = _pictured(scene, scene.points[kept])
        inside = share >= OBJECT_SHARE  # masks are rough: some may miss what others show
        kept, colors = kept[inside], (pictured if colors is None else colors)[inside]
    if len(kept) < MIN_POINTS:
        return None
    source = f"{len(kept):,} points of the capture"
    if len(kept) > most:
        chosen = np.sort(random.choice(len(kept), most, replace=False))
        kept, colors = kept[chosen], None if colors is None else colors[chosen]
        source = f"{most:,} of {source}"
    centers = scene.points[kept]
    return centers, _pictured(scene, centers)[0] if colors is None else colors, source


def _surface_places(
    scene: Scene, count: int, random: np.random.Generator, device: wp.DeviceLike
) -> tuple[np.ndarray, np.ndarray, str]:
    """Places (n, 3) that a quick fit of voxels shows in the views, with their colours, and what they are."""
    from ..optimizer import FieldOptimizer

    side = QUICK_SIDE_CPU if resolve_device(device).is_cpu else QUICK_SIDE  # where more would take minutes
    small = _shrunk(scene, math.ceil(max(scene.images.shape[1:3]) / side))
    optimizer = FieldOptimizer(small, device=device, seed=int(random.integers(2**31)), quality="fast", **QUICK_FIT)
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
    field, share = optimizer.finish(), 2 * math.ceil(count / len(scene))
    places, colors = [], []
    for camera in small.cameras:
        frame = field.render(camera)
        depth, shown = frame.depth.ravel(), np.clip(frame.rgb.reshape(-1, 3), 0.0, 1.0)
        seen = np.flatnonzero((frame.alpha.ravel() > OPAQUE) & np.isfinite(depth))
        chosen = random.permutation(seen)[:share]
        origins, directions = (rays.reshape(-1, 3)[chosen] for rays in camera.rays())
        places.append(origins + depth[chosen, None] * directions)
        colors.append(shown[chosen])
    found, rgb = np.concatenate(places), np.concatenate(colors)
    focus, unit, _ = scene_units(scene)
    near = np.flatnonzero(np.linalg.norm(found - focus, axis=1) <= FARTHEST * unit)
    kept = np.sort(random.permutation(near)[:count])
    return found[kept], rgb[kept], f"{len(kept):,} places on a quick fit of voxels"


def shrunk_camera(camera: Camera, side: int) -> Camera:
    """A camera whose picture is smaller by a whole factor; what is left over at the right and below is cut off."""
    lengths = {name: getattr(camera, name) / side for name in ("fx", "fy", "cx", "cy")}
    return dataclasses.replace(camera, **lengths, width=camera.width // side, height=camera.height // side)


def _shrunk(scene: Scene, side: int) -> Scene:
    """A scene with pictures that are smaller by a whole factor; what is left over at the right and below is cut off."""
    height, width = (n // side for n in scene.images.shape[1:3])
    images = scene.images[:, : height * side, : width * side].reshape(len(scene), height, side, width, side, 3)
    cameras = [shrunk_camera(camera, side) for camera in scene.cameras]
    weights = None if scene.weights is None else shrink_weights(scene.weights[:, : height * side, : width * side], side)
    shrunk = images.mean(axis=(2, 4), dtype=np.float32)
    return dataclasses.replace(scene, images=shrunk, cameras=cameras, weights=weights)


def _places_inside(scene: Scene, count: int, random: np.random.Generator, device: wp.DeviceLike) -> np.ndarray:
    """Places (count, 3) evenly inside the visual hull of the object."""
    device, step = resolve_device(device), math.ceil(len(scene) / CARVING_VIEWS)
    assert scene.alphas is not None
    carving = scene if step == 1 else scene.subset(slice(None, None, step))
    silhouettes = Silhouettes(carving, device)
    box = scene_box(scene, silhouettes).bounds
    size = box[1] - box[0]
    shape = tuple(int(n) for n in np.maximum(np.round(RESOLUTION * size / size.max()), 1))
    mask = possible_voxels(silhouettes, carving.cameras, box, shape, VIEW_SHARE, device, neighbors=False)
    voxels = np.argwhere(mask.numpy())
    corners = voxels[random.integers(len(voxels), size=count)]
    return box[0] + (corners + random.random((count, 3))) * (size / shape)


def _places_seen(scene: Scene, count: int, random: np.random.Generator) -> np.ndarray:
    """Places (count, 3) in the views, evenly over inverse distance, that several cameras have in their picture."""
    _, unit, _ = scene_units(scene)
    cameras, wanted = scene.cameras, min(VIEWS, len(scene))
    held: list[list[np.ndarray]] = [[] for _ in range(wanted + 1)]  # by the number of views that see them
    for _ in range(TRIES):
        places = _frustum_places(cameras, count, unit, random)
        looking = random.permutation(len(cameras))[:LOOKING_VIEWS]
        counts = _view_counts([cameras[view] for view in looking], places, wanted, NEAR * unit)
        for views in range(wanted + 1):
            held[views].append(places[counts == views])
        if sum(map(len, held[wanted])) >= count:
            break
    return np.concatenate([each for places in held[::-1] for each in places])[:count]


def _frustum_places(cameras: list[Camera], count: int, unit: float, random: np.random.Generator) -> np.ndarray:
    """Places (count, 3), each in a random pixel of a random camera."""
    views = random.integers(len(cameras), size=count)
    across, down = random.random((2, count))
    distances = 1.0 / random.uniform(1.0 / (FAR * unit), 1.0 / (NEAR * unit), count)
    lenses = np.array([[camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height] for camera in cameras])
    fx, fy, cx, cy, width, height = lenses[views].T
    local = np.stack([(across * width - cx) / fx, (down * height - cy) / fy, np.ones(count)], axis=1)
    local *= (distances / np.linalg.norm(local, axis=1))[:, None]
    poses = np.stack([camera.camera_to_world for camera in cameras])[views]
    return np.einsum("nij,nj->ni", poses[:, :3, :3], local) + poses[:, :3, 3]


def _view_counts(cameras: list[Camera], places: np.ndarray, enough: int, near: float) -> np.ndarray:
    """How many cameras have each place (n, 3) in their picture, not nearer than that; counted to `enough`."""
    counts, open_rows = np.zeros(len(places), np.int64), np.arange(len(places))
    for camera in cameras:
        rows, _, _ = _pixels(camera, places[open_rows], near)
        counts[open_rows[rows]] += 1
        open_rows = open_rows[counts[open_rows] < enough]
    return counts


def _pixels(camera: Camera, places: np.ndarray, near: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which places (n, 3) a camera has in its picture, and the row and the column of the pixel of each of them."""
    pixels, depths = camera.project(places)
    inside = (pixels >= 0.0) & (pixels < (camera.width, camera.height))
    seen = np.flatnonzero((depths > near) & inside.all(axis=1))
    columns, rows = pixels[seen].astype(np.int64).T
    return seen, rows, columns


def _pictured(scene: Scene, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (n, 3) of places, means over views that show the object there, grey where none does; and the share (n,)
    of the views that do, 0 where none has them in its picture."""
    sums, shown, seen = np.zeros((len(places), 3)), np.zeros(len(places)), np.zeros(len(places))
    for view in np.unique(np.linspace(0, len(scene) - 1, COLOR_VIEWS).round().astype(int)):
        indices, rows, columns = _pixels(scene.cameras[view], places)
        colors = scene.images[view, rows, columns].astype(np.float64)
        counts = np.ones(len(indices), bool) if scene.weights is None else scene.weights[view, rows, columns] > 0.0
        is_shown = counts
        if scene.alphas is not None:
            alphas = scene.alphas[view, rows, columns].astype(np.float64)[:, None]
            colors -= (1.0 - alphas) * scene.background
            is_shown = counts & (alphas[:, 0] >= OPAQUE)
            colors /= np.maximum(alphas, OPAQUE)
        sums[indices[is_shown]] += colors[is_shown]
        shown[indices[is_shown]] += 1.0
        seen[indices[counts]] += 1.0
    means = np.where(shown[:, None] > 0, sums / np.maximum(shown, 1.0)[:, None], 0.5)
    return np.clip(means, 0.0, 1.0).astype(np.float32), shown / np.maximum(seen, 1.0)


def _log_scales(centers: np.ndarray, scene: Scene) -> np.ndarray:
    """Logarithms (n,) float32 of the root mean square distance to the nearest neighbours."""
    from scipy.spatial import KDTree

    neighbors = min(NEIGHBORS, len(centers) - 1)
    sizes = np.zeros(len(centers))
    if neighbors:
        distances, _ = KDTree(centers).query(centers, neighbors + 1, workers=cpu_threads())
        sizes = np.sqrt((np.asarray(distances)[:, 1:] ** 2).mean(axis=1))
    apart = sizes[sizes > 0.0]
    least = MIN_SIZE * (float(np.median(apart)) if len(apart) else scene_units(scene)[1])
    return np.log(np.maximum(sizes, least)).astype(np.float32)
