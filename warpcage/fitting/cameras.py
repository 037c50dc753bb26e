"""Refine the cameras of a scene and the exposure of its pictures while a field is fitted; poses of test views."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.checks import require_type
from ..core.devices import lane_count, launch
from ..core.npz import require_numbers
from ..core.threads import device_turn
from ..errors import InputError
from ..field.render import STOP_TRANSMITTANCE
from ..field.surroundings import OuterField
from ..field.voxel_field import VoxelField
from ..kernels.fitting import cameras as kernels
from ..kernels.fitting.background_loss import gather_background
from ..kernels.fitting.loss import TrainingRays
from ..kernels.fitting.outer_loss import gather_outer
from ..kernels.view.rays import PinholeCamera
from ..scene.scene import Scene
from ..view.alignment import picture_moves, picture_shifts, picture_similarity, pose_changes, spread_of
from ..view.camera import Camera
from .batches import Batches
from .evaluation import comparison, in_world_of
from .memory import memory_limit
from .schedule import CameraRates

NUMBERS, SUMS = int(kernels.CAMERA_NUMBERS), int(kernels.CAMERA_SUMS)

_NORMAL, _EXPOSURE = int(kernels.NORMAL_SUMS), int(kernels.EXPOSURE_SUMS)

#: What Gauss-Newton's diagonal is raised by, as a share of itself and of the camera's largest: steps are short along
#: what the pictures determine badly, as a turn and a shift across it that show the object the same way.
DAMPING, MIN_DAMPING = 0.05, 1e-5

#: How firmly the given cameras hold theirs at least, relative to what pictures determine best: turns, shifts and focal
#: length.
HOLD = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3, 1e-3])

#: Strength of the exposures' prior, as a share of the pixels' number: that gains are 1 and offsets 0.
EXPOSURE_PRIOR, OFFSET_PRIOR = 0.005, 0.3

#: Gains of an exposure beyond these are not believed.
GAINS = (0.2, 5.0)

#: Keeps quotients finite where no ray counts.
TINY = 1e-30


@dataclasses.dataclass(frozen=True, eq=False)
class CameraSums:
    """What a sample of rays says of their cameras."""

    normal: np.ndarray  # (n, 7, 7) float64, J^T J by turns, shifts and logarithm of the focal length
    slope: np.ndarray  # (n, 7) J^T e
    exposure: np.ndarray  # (n, 3, 5) sums of x x, x a, a a, x y and a y for each channel; see kernels/fitting/cameras
    error: np.ndarray  # (n,) e^T e

    @classmethod
    def unpacked(cls, sums: np.ndarray) -> CameraSums:
        """From (n, 51) as the kernel packs them."""
        normal = np.zeros((len(sums), NUMBERS, NUMBERS))
        rows, columns = np.triu_indices(NUMBERS)
        normal[:, rows, columns] = normal[:, columns, rows] = sums[:, :_NORMAL]
        slope, exposure, error = np.split(sums[:, _NORMAL:], [NUMBERS, NUMBERS + _EXPOSURE], axis=1)
        return cls(normal, slope, exposure.reshape(-1, 3, 5), error[:, 0])


@dataclasses.dataclass(frozen=True)
class CameraErrors:
    """How far off a fit's cameras are."""

    pixels: float  # in the median over the cameras, as both halves of their rays say together
    cosine: float  # in the median, between what each half says: 1 where they agree

    def __bool__(self) -> bool:
        """Whether to refine them."""
        return self.pixels > OFF_PIXELS and self.cosine > OFF_COSINE

    def __str__(self) -> str:
        if self:
            return f"cameras were off by {self.pixels:.1f} pixels in the median: refined"
        return (
            f"cameras are kept as given: halves of the rays see them off by {self.pixels:.2f} pixels in the median "
            f"and agree to {self.cosine:.2f}, too little to refine them"
        )


def camera_steps(
    normal: np.ndarray,
    slope: np.ndarray,
    lenses: np.ndarray,
    changes: np.ndarray | None = None,
    firmness: np.ndarray | float = 0.0,
    *,
    lenses_move: bool = True,
) -> np.ndarray:
    """A damped step of Gauss-Newton (n, 7) for cameras of which some share a lens; J^T J (n, 7, 7) and J^T e (n, 7).
    changes: (n, 7) from the given cameras, None holds nothing; firmness: (n, 7) how firmly those hold beyond HOLD."""
    diagonal = np.einsum("nii->ni", normal)
    largest = diagonal.max(axis=1, keepdims=True)
    added = DAMPING * diagonal + MIN_DAMPING * largest + TINY
    if changes is not None:
        hold = (HOLD + firmness) * largest
        slope, added = slope + hold * changes, added + hold
    raised = normal.copy()
    raised[:, np.arange(NUMBERS), np.arange(NUMBERS)] += added
    # Cameras are eliminated first, lenses last (Schur; Triggs et al. 2000, "Bundle adjustment", section 6).
    crossing = raised[:, :6, 6:]
    solved = np.linalg.solve(raised[:, :6, :6], np.concatenate([slope[:, :6, None], crossing], axis=2))
    complement = raised[:, 6, 6] - (crossing[..., 0] * solved[..., 1]).sum(axis=1)
    remainder = slope[:, 6] - (crossing[..., 0] * solved[..., 0]).sum(axis=1)
    lens_steps = -np.bincount(lenses, remainder) / np.maximum(np.bincount(lenses, complement), TINY)
    along = lenses_move * lens_steps[lenses][:, None]  # poses do not make up for a zoom that does not come
    return np.concatenate([-solved[..., 0] - solved[..., 1] * along, along], axis=1)


def fitted_exposures(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gains and offsets (n, 3) that make a field's colours those of its pictures, by exposure sums (n, 3, 5)."""
    xx, xa, aa, xy, ay = np.moveaxis(sums, -1, 0)  # y = gain x + offset a, by least squares, for gain - 1 and offset
    xy, ay = xy - xx, ay - xa  # so that a view of which nothing counts has a gain of 1
    xx, aa = xx + EXPOSURE_PRIOR * aa + TINY, (1.0 + OFFSET_PRIOR) * aa + TINY
    determinant = np.maximum(xx * aa - xa * xa, TINY)
    gains = np.clip(1.0 + (aa * xy - xa * ay) / determinant, *GAINS)
    return gains, (xx * ay - xa * xy) / determinant


def even_exposures(gains: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exposures relative to their mean: what undoes them has the geometric mean 1 and the mean offset 0."""
    gains = gains / np.exp(np.log(gains).mean(axis=0))
    return gains, offsets - gains * (offsets / gains).mean(axis=0)


RECORD = int(kernels.RECORD)

#: Rays that look at the cameras for each ray of the batches between two of their steps.
CAMERA_RAYS = 0.15

#: Rays of a camera that one item adds up, at most.
RUN = 64

#: Change of a camera's number by which what is around the field is differenced: about a pixel.
CHANGE = 1e-3

#: Length of a ray's residual (of colours in [0, 1]) from which it counts for less.
OUTLIER = 1.0

#: Share that past steps keep of the normal equations' matrix.
KEPT = 0.8

#: A step moves no part of the picture by more voxels of the level than this.
MAX_VOXELS = 0.5

#: Pixels below about twice which a move of a camera is not believed; and change of the gains, in the mean of all
#: pictures or half of a picture's own, below which exposures are not: some of what depends on the view looks like them.
DOUBT, EXPOSURE_DOUBT = 0.1, 0.07

#: Cameras are off where two disjoint halves of their rays say so: by more pixels than this in the median, together, and
#: alike, by a larger cosine between what each says. What rays miss by chance is not alike. A look at a field that the
#: cameras blurred sees about two thirds of what they are off by (benchmarks/NOTES-cameras.md).
OFF_PIXELS, OFF_COSINE = 0.2, 0.6

#: Rays of each half, over those of a look before a step.
HALF_LOOKS = 4

#: Points by which the cameras as a whole are held fill this share of the box's sides.
POINTS_SHARE = 0.6

#: Bytes of a ray's record, and of what is around the field for it.
RAY_BYTES, AROUND_BYTES = 12 * RECORD, (12 + 16) * (1 + NUMBERS)

#: Fills what is behind each of a batch's TrainingRays, and what is before it, where there is such an object.
Gather = Callable[[Any, wp.array, "wp.array | None"], None]

#: Looks at every camera with tiles of TrainingRays, of which (n + 1,) say where each view's begin.
Look = Callable[[Any, np.ndarray], CameraSums]


class CameraRefinement:
    """The cameras of a fit and the exposures of its pictures, as they are refined."""

    # Damped Gauss-Newton for each pose's six numbers, and for a lens's focal length with all its cameras. Held, as
    # pictures cannot determine: where all cameras together see the middle of the box, mean gains of 1, offsets of 0.

    def __init__(self, cameras: Sequence[Camera], bounds: np.ndarray, device: wp.Device, *, held: bool = True):
        self.given, self.device, self.held = list(cameras), device, held  # held: all as a whole, and each a little
        self.center = bounds.mean(axis=0)  # positions on the device are relative to it
        grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        self.points = self.center + 0.5 * POINTS_SHARE * grid * (bounds[1] - bounds[0])
        keys = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras]
        found = {key: index for index, key in enumerate(dict.fromkeys(keys))}
        self.lenses = np.array([found[key] for key in keys])  # of each camera; same numbers share one
        self.given_poses = np.array([camera.camera_to_world for camera in cameras])
        self.poses, self.zooms = self.given_poses.copy(), np.zeros(len(found))  # (n, 4, 4); log focal over the given
        self.gains, self.offsets = np.ones((len(keys), 3)), np.zeros((len(keys), 3))  # colours * gains + offsets
        self.normal = np.zeros((len(keys), NUMBERS, NUMBERS))  # running mean of the normal equations' matrices
        # world units of a shift by 1: how far the cameras are from the middle
        self.reach = float(np.median(np.linalg.norm(self.poses[:, :3, 3] - self.center, axis=1)))

    def __len__(self) -> int:
        return len(self.given)

    @property
    def cameras(self) -> list[Camera]:
        """The cameras as they are now."""
        factors = np.exp(self.zooms[self.lenses])
        return [
            dataclasses.replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, camera_to_world=pose)
            for camera, factor, pose in zip(self.given, factors, self.poses, strict=True)
        ]

    # On the device

    def uploaded(
        self, number: int | None = None, change: float = 0.0, *, size: tuple[int, int] | None = None
    ) -> wp.array:
        """(n,) PinholeCamera as they are, or with one of their numbers larger by `change`; size: width and height that
        the images have which hold the pictures, None takes those of the cameras."""
        rows = np.zeros(len(self), np.dtype(cast(Any, PinholeCamera).numpy_dtype()))
        rotations, centers, zooms = self.poses[:, :3, :3], self.poses[:, :3, 3] - self.center, self.zooms[self.lenses]
        if number is not None and number < 3:
            rotations = turned(rotations, np.tile(change * np.eye(3)[number], (len(self), 1)))
        elif number is not None and number < 6:
            centers = centers + self.reach * change * rotations[:, :, number - 3]
        elif number is not None:
            zooms = zooms + change
        rows["center"], rows["rotation"] = centers, rotations
        rows["focal"] = np.array([[c.fx, c.fy] for c in self.given]) * np.exp(zooms)[:, None]
        rows["principal_point"] = [[c.cx, c.cy] for c in self.given]
        rows["width"], rows["height"] = size or np.transpose([(c.width, c.height) for c in self.given])
        return wp.array(rows, dtype=PinholeCamera, device=self.device)

    def attach(self, rays: Any) -> None:
        """Let TrainingRays of the scene have the cameras and exposures as they are."""
        rays.cameras = self.uploaded(size=(rays.width, rays.height))
        undone = np.stack([1.0 / self.gains, -self.offsets / self.gains], axis=1)
        rays.exposures = wp.array(undone, dtype=wp.vec3, device=self.device)

    def measure(
        self,
        field: VoxelField,
        rays: Any,
        view_tiles: np.ndarray,
        tiles: int,
        *,
        seed: int,
        random_background: bool,
        gather: Gather | None = None,
        has_front: bool = False,
        ignored: np.ndarray | None = None,  # (n,) views of which nothing counts
    ) -> CameraSums:
        """Look at every camera with a sample of so many tiles of TrainingRays, which have the cameras as they are.
        view_tiles: (n + 1,) int32, where the tiles of each view begin; gather: fills what is around the field."""
        device, size = self.device, rays.tile_size**2
        run_tiles = max(1, RUN // size)  # a few more tiles of each camera are taken where that fills runs
        runs = -(-tiles // run_tiles)
        drawn = _copied(rays)
        drawn.tiles = empty_array(len(self) * runs * run_tiles, wp.int32, device)
        drawn.order, drawn.first_tile = -1, 0
        starts = wp.array(view_tiles, dtype=wp.int32, device=device)
        whole = -(-rays.height // rays.tile_size) * -(-rays.width // rays.tile_size)
        inputs = [rays.tiles, starts, whole, runs * run_tiles, seed]
        launch(kernels.draw_tiles, drawn.tiles.size, inputs, [drawn.tiles], device=device)
        count = drawn.tiles.size * size
        behind, front = self._around(drawn, count, gather, has_front)
        records = empty_array((count, RECORD), wp.vec3, device)
        inputs = [
            field.grid,
            drawn,
            wp.vec3(*map(float, field.background)),
            int(random_background),
            seed,
            field.step,
            STOP_TRANSMITTANCE,
            self.reach,
            behind,
            front,
            CHANGE,
        ]
        launch(kernels.measure_camera_slopes, count, inputs, [records], device=device)
        sums = empty_array((len(self) * runs, SUMS), wp.float32, device)
        launch(kernels.sum_camera_slopes, sums.size, [records, run_tiles * size, OUTLIER], [sums], device=device)
        found = CameraSums.unpacked(sums.numpy().astype(np.float64).reshape(len(self), runs, SUMS).sum(axis=1))
        if ignored is not None:  # as if the picture were right where its camera is
            found.normal[ignored], found.slope[ignored], found.error[ignored] = 0.0, 0.0, 0.0
            found.exposure[ignored] = [1.0, 0.0, 1.0, 1.0, 0.0]
        return found

    def _around(self, drawn: Any, count: int, gather: Gather | None, has_front: bool) -> tuple[wp.array, wp.array]:
        """(8, rays) what is behind and before the field: as it is, and with each of the cameras' numbers larger."""
        shapes = [(1 + NUMBERS, count) if there else (0, 0) for there in (gather is not None, has_front)]
        behind: Any = wp.zeros(shapes[0], dtype=wp.vec3, device=self.device)
        front: Any = wp.zeros(shapes[1], dtype=wp.vec4, device=self.device)
        if gather is not None:
            cameras = drawn.cameras
            for place in range(1 + NUMBERS):
                drawn.cameras = cameras if place == 0 else self.uploaded(place - 1, CHANGE)
                gather(drawn, behind[place], front[place] if has_front else None)
            drawn.cameras = cameras
        return behind, front

    # Whether they are off

    def errors(
        self, rays: Any, view_tiles: np.ndarray, measure: Callable[[Any, np.ndarray], CameraSums]
    ) -> CameraErrors:
        """How far off the cameras are by disjoint halves of their tiles; `measure` looks at tiles of TrainingRays."""
        tiles, moves = rays.tiles.numpy(), []
        for half in (0, 1):
            part = _copied(rays)
            part.tiles = wp.array(tiles[half::2], dtype=wp.int32, device=self.device)
            sums = measure(part, (view_tiles + 1 - half) // 2)
            moves.append(self._moves(camera_steps(sums.normal, sums.slope, self.lenses)))
        first, second = moves
        known = np.array([spread_of(each) for each in moves]).min(axis=0) > 0.0
        if not known.any():
            return CameraErrors(0.0, 0.0)
        focal = np.array([camera.fx for camera in self.given])
        pixels = focal * spread_of(0.5 * (first + second))
        cosines = np.nansum(first * second, axis=(1, 2)) / np.sqrt(
            np.maximum(np.nansum(first**2, axis=(1, 2)) * np.nansum(second**2, axis=(1, 2)), TINY)
        )
        return CameraErrors(float(np.median(pixels[known])), float(np.median(cosines[known])))

    def _moves(self, steps: np.ndarray) -> np.ndarray:
        """(n, points, 2) where steps (n, 7) move what the cameras see, in focal lengths."""
        moved = self.poses.copy()
        moved[:, :3, 3] += self.reach * np.einsum("nij,nj->ni", self.poses[:, :3, :3], steps[:, 3:6])
        moved[:, :3, :3] = turned(self.poses[:, :3, :3], steps[:, :3])
        return picture_moves(self.poses, moved, self.points, steps[:, 6])

    # Steps

    def step(self, sums: CameraSums, rates: CameraRates, voxel: float) -> None:
        """Move the cameras and change the exposures by what their rays say; voxel: side, world units."""
        met = self.normal.any(axis=(1, 2), keepdims=True)
        self.normal = np.where(met, KEPT * self.normal + (1.0 - KEPT) * sums.normal, sums.normal)
        changes, firmness = (self.changes(), self._firmness(rates)) if self.held else (None, 0.0)
        moving = rates.lenses > 0.0
        steps = camera_steps(self.normal, sums.slope, self.lenses, changes, firmness, lenses_move=moving)
        most = MAX_VOXELS * voxel / self.reach
        farthest = np.abs(steps[:, :6]).max(axis=1, keepdims=True)
        moves = steps[:, :6] * np.minimum(rates.poses, most / np.maximum(farthest, 1e-30))
        rotations = self.poses[:, :3, :3]
        self.poses[:, :3, 3] += self.reach * np.einsum("nij,nj->ni", rotations, moves[:, 3:])
        self.poses[:, :3, :3] = turned(rotations, moves[:, :3])
        firsts = np.unique(self.lenses, return_index=True)[1]
        self.zooms += np.clip(rates.lenses * steps[firsts, 6], -most, most)
        if self.held:
            self.poses = picture_similarity(self.poses, self.given_poses, self.points).moved_poses(self.poses)
        gains, offsets = fitted_exposures(sums.exposure)
        if self.held:
            gains, offsets = even_exposures(gains, offsets)
            changes = np.sqrt((np.log(gains) ** 2 + offsets**2).mean(axis=1, keepdims=True))
            changes = np.maximum(np.sqrt((changes**2).mean()), 0.5 * changes)
            kept = 1.0 / (1.0 + doubted(changes, EXPOSURE_DOUBT))
            gains, offsets = gains**kept, kept * offsets
        self.gains = self.gains * (gains / self.gains) ** rates.exposures
        self.offsets = self.offsets + rates.exposures * (offsets - self.offsets)
        if self.held:
            self.gains, self.offsets = even_exposures(self.gains, self.offsets)

    def _firmness(self, rates: CameraRates) -> np.ndarray:
        """(n, 7) how firmly the given cameras hold theirs: by how little those have moved."""
        # A camera that the pictures alone would move by y settles at x = y / (1 + (DOUBT / x)^4): almost y far off, 0
        # below 1.75 DOUBT (as the garrote of Breiman 1995). So little does an inexact field ask of exact cameras.
        focal = np.array([camera.fx for camera in self.given])
        moved = focal * picture_shifts(self.poses, self.given_poses, self.points)
        # how far from the middle of a picture the object reaches
        size = np.sqrt(((self.points - self.center) ** 2).sum(axis=1).mean()) / self.reach
        zoomed = focal * size * np.abs(self.zooms[self.lenses])
        doubts = [doubted(moved, DOUBT)] * 6 + [doubted(zoomed, DOUBT)]
        return rates.doubt * np.stack(doubts, axis=1)

    def changes(self) -> np.ndarray:
        """(n, 7) the numbers of each camera relative to the given one."""
        changes = pose_changes(self.given_poses, self.poses)
        return np.concatenate([changes[:, :3], changes[:, 3:] / self.reach, self.zooms[self.lenses][:, None]], axis=1)

    # State

    def state(self) -> dict[str, np.ndarray]:
        """All that changes, for a checkpoint."""
        return {f"camera_{name}": getattr(self, name) for name in STATE}

    def restore(self, contents: dict[str, np.ndarray], path: pathlib.Path) -> None:
        """Take over a state from a checkpoint's arrays; path: for errors."""
        held = {}
        for name in STATE:
            now = getattr(self, name)
            held[name] = np.asarray(require_numbers(contents, f"camera_{name}", now.shape, path), np.float64)
            if not np.isfinite(held[name]).all():
                raise InputError(f"camera_{name} holds values that are not finite")
        if held["gains"].min(initial=1.0) <= 0 or np.abs(held["zooms"]).max(initial=0.0) > MAX_ZOOM:
            raise InputError("the cameras hold values that cannot be")
        for name, values in held.items():
            setattr(self, name, values)


#: The attributes of a CameraRefinement that change, and largest logarithm of a focal length over the given one.
STATE = ("poses", "zooms", "gains", "offsets", "normal")

MAX_ZOOM = 3.0


def doubted(change: np.ndarray, doubt: float) -> np.ndarray:
    """How strongly changes are held back that may be none: (doubt / change)^4, at most a million."""
    return np.minimum((doubt / np.maximum(change, 1e-9)) ** 4, 1e6)


def _copied(rays: Any) -> Any:
    """TrainingRays of the same arrays."""
    copied: Any = TrainingRays()
    for name in TrainingRays.vars:
        setattr(copied, name, getattr(rays, name))
    return copied


def turned(rotations: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) after turns (n, 3) about their own axes, radians."""
    from scipy.spatial.transform import Rotation

    left, _, right = np.linalg.svd(rotations @ Rotation.from_rotvec(turns).as_matrix())
    return left @ right  # many steps leave no rounding


def ray_bytes(rays: int) -> int:
    """Device memory of a look at cameras with so many rays."""
    return (RAY_BYTES + AROUND_BYTES) * rays


#: Steps, and pixels of each view that one looks at.
STEPS, PIXELS = 24, 4096

#: Side of the tiles that pixels are drawn in.
TILE = 2


def tuned_scene(field: VoxelField, scene: Scene) -> Scene:
    """A scene whose cameras are turned and shifted so that its pictures match a field best, in the field's world."""
    # A field fitted with refined cameras lies where those see it, but a held-out view's camera was not refined: its
    # pose is found with the field fixed (damped Gauss-Newton), as NeRF-- (Wang et al. 2021, section 4) and BARF (Lin et
    # al. 2021, section 4) do. That measures the field, not where views are: say so.
    require_type(scene, Scene, "views are tuned in")
    scene = in_world_of(field, scene)
    behind, images = comparison(field, scene)
    compared = scene
    if behind is None:
        compared = dataclasses.replace(scene, images=images, alphas=None, surroundings=None)
    device = field.device
    with device_turn(device):
        random = np.random.default_rng(0)
        limit = memory_limit(None, device)
        batches = Batches(compared, field.center, TILE, random, device, held=0, limit=limit)
        batches.take(batches.counted_tiles)
        refinement = CameraRefinement(compared.cameras, field.bounds, device, held=False)
        around = field.background_model if behind is None else None
        has_front = isinstance(around, OuterField)

        def gather(rays: Any, colors: wp.array, front: wp.array | None) -> None:
            if isinstance(around, OuterField):
                items = lane_count(device) * colors.size
                launch(gather_outer, items, [around.grid, rays], [front, colors], device=device)
            elif around is not None:
                launch(gather_background, colors.size, [around.layers, rays], [colors], device=device)

        for step in range(STEPS):
            batches.rays.cameras = refinement.uploaded()
            sums = refinement.measure(
                field,
                batches.rays,
                batches.view_tiles,
                max(1, PIXELS // TILE**2),
                seed=step,
                random_background=False,
                gather=None if around is None else gather,
                has_front=has_front,
                ignored=batches.ignored_views,
            )
            share = 1.0 if 2 * step < STEPS else 0.3
            refinement.step(sums, CameraRates(share, 0.0, 0.0), float(field.voxel_size.max()))
    return dataclasses.replace(scene, cameras=refinement.cameras)
