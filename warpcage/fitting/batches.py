"""The pixels of a scene on a device, in batches of square tiles, and sums of gradients over CPU threads."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.devices import launch, launch_off_tape, module_block_dim
from ..core.modules import Kernel, require_loaded
from ..core.npz import require_numbers
from ..core.threads import cpu_threads, device_turn, run_parallel
from ..errors import InputError
from ..field.sparse import gathered
from ..field.voxel_field import VoxelField
from ..kernels.fitting.batches import Pictures, mark_active_tiles
from ..kernels.fitting.loss import TrainingRays
from ..kernels.fitting.rmsprop import add_gradients, count_marks, join_maximum
from ..scene.scene import Scene
from ..view.camera import camera_array
from ..view.pictures import to_uint8
from .memory import MAX_ITEMS, require_image_memory
from .schedule import view_factors

#: Bits per channel that pictures may be kept at, the better first. Files have 8; opacity and averaging need more.
PRECISIONS = (16, 8)


def picture_bytes(scene: Scene, bits: int) -> int:
    """Device memory of a scene's pictures, and what masks split off them, at so many bits for each of four channels;
    and of their weights."""
    kinds, pixels = 1 if scene.surroundings is None else 2, math.prod(scene.images.shape[:3])
    return kinds * pixels * 4 * bits // 8 + (0 if scene.weights is None else pixels)


def counted_pixels(scene: Scene) -> int:
    """How many pixels of a scene's pictures count; ValueError where none does."""
    count = math.prod(scene.images.shape[:3]) if scene.weights is None else int((scene.weights > 0.0).sum())
    if count == 0:
        raise InputError("no pixel of the pictures counts: all weights are 0, there is nothing to fit")
    return count


def chosen_bits(scene: Scene, held: int, limit: int) -> int:
    """The best of PRECISIONS for a scene's pictures that fits, beside `held` bytes, into `limit` bytes."""
    needed = {bits: held + picture_bytes(scene, bits) for bits in PRECISIONS}
    require_image_memory(needed[PRECISIONS[-1]], limit)
    return next(bits for bits in PRECISIONS if needed[bits] <= limit)


class TrainingPictures:
    """The pictures of a scene on a device, and what masks split off them; bits: per channel, one of PRECISIONS."""

    def __init__(self, scene: Scene, bits: int, device: wp.Device):
        self.scene, self.device, self.bits = scene, device, bits
        self.seen: Any = None  # premultiplied colours and opacity
        self.surroundings: Any = None  # colours that masks split off times their share, and the share; None if none
        given = () if scene.weights is None else scene.weights  # above 0 however little: those count
        weights = [np.maximum(np.round(255.0 * each), each > 0.0).astype(np.uint8) for each in given]
        counted = np.stack(weights) if weights else np.zeros((0, 0, 0), np.uint8)
        self.counted: wp.array = wp.array(counted, dtype=wp.uint8, device=device)  # (views, h, w) in 1/255; empty: all
        self.keep(bits)

    def keep(self, bits: int) -> None:
        """Upload them at another precision, bits per channel."""
        self.seen = self.surroundings = None  # frees the arrays first, where nothing else holds them
        self.bits = bits
        scene = self.scene
        opacity = np.ones(scene.images.shape[:3], np.float32) if scene.alphas is None else scene.alphas
        self.seen = _uploaded(scene.images, opacity, -scene.background, bits, self.device)
        if scene.surroundings is not None:
            self.surroundings = _uploaded(scene.surroundings, 1.0 - opacity, np.zeros(3, np.float32), bits, self.device)

    @property
    def held_bytes(self) -> int:
        """Device memory of the pictures."""
        return picture_bytes(self.scene, self.bits)

    @property
    def spare_bytes(self) -> int:
        """Device memory that the lowest precision would give back."""
        return self.held_bytes - picture_bytes(self.scene, PRECISIONS[-1])


def _uploaded(images: np.ndarray, shares: np.ndarray, behind: np.ndarray, bits: int, device: wp.Device) -> Any:
    """Pictures of each pixel's colour + (1 - share) * behind, and of its share."""
    pixels = np.empty((*images.shape[:3], 4), np.float16 if bits == 16 else np.uint8)

    def pack(target: np.ndarray, image: np.ndarray, share: np.ndarray) -> None:
        values = np.concatenate([image + (1.0 - share[..., None]) * behind, share[..., None]], axis=-1)
        target[...] = values if bits == 16 else to_uint8(values)

    run_parallel([lambda view=view: pack(pixels[view], images[view], shares[view]) for view in range(len(pixels))])
    pictures: Any = Pictures()
    if bits == 16:
        pictures.halves = wp.array(pixels, dtype=wp.vec4h, device=device)
    else:
        pictures.bytes = wp.array(pixels, dtype=wp.vec4ub, device=device)
    return pictures


#: Tiles are taken where they hold this share of the pixels that count, at least: single pixels otherwise.
TILES_SHARE = 0.9


def tile_weights(weights: np.ndarray, tile_size: int) -> np.ndarray:
    """(tiles,) the least weight in each tile of pictures, by their weights (n, h, w)."""
    for axis in (1, 2):
        weights = np.minimum.reduceat(weights, np.arange(0, weights.shape[axis], tile_size), axis)
    return weights.ravel()


def counted_tile_size(weights: np.ndarray | None, tile_size: int) -> int:
    """The side of tiles, pixels, that is asked for; 1 where too few tiles count as a whole."""
    if weights is None:
        return tile_size
    held = tile_size**2 * int((tile_weights(weights, tile_size) > 0.0).sum())
    return tile_size if held >= TILES_SHARE * int((weights > 0.0).sum()) else 1


#: Bytes of a tile's index, and of the squared error of a ray of a batch.
TILE_BYTES, ERROR_BYTES = 4, 4

#: Steps of a field's march along which a tile is looked through.
ACTIVE_STEP = 2.0

#: Keys of orders.
ORDERS = 2**31

#: Least mean squared error that a PSNR is computed from.
MIN_ERROR = 1e-12


@dataclasses.dataclass(frozen=True)
class Batch:
    """One batch, as the photometric loss takes it."""

    rays: Any  # TrainingRays that begin at the batch's first tile
    squared_error: wp.array  # (rays,) float32, where the loss leaves the error of each ray
    seed: int  # of the places within pixels and of random backgrounds
    random_background: bool
    behind: wp.array | None  # (rays,) vec3 behind the field, None is one colour; then the gradient by it
    grad_behind: wp.array | None
    front: wp.array | None  # (rays,) vec4 before it with the light that passes, None is nothing; then the gradient
    grad_front: wp.array | None

    @property
    def size(self) -> int:
        """Rays of the batch."""
        return self.squared_error.size


class Batches:
    """The pixels of a scene's pictures in batches: runs of square tiles in a shuffled order."""

    def __init__(
        self,
        scene: Scene,
        center: np.ndarray,  # (3,) world point that positions are relative to
        tile_size: int,
        random: np.random.Generator,
        device: wp.Device,
        *,
        held: int,  # bytes that others hold while the pictures are uploaded
        limit: int,  # bytes that the fit may take; both decide the precision
    ):
        count, height, width = scene.images.shape[:3]
        self.device, self.random = device, random
        self.rays: Any = TrainingRays()  # what the losses take
        whole = [dataclasses.replace(camera, width=width, height=height) for camera in scene.cameras]
        self.rays.cameras = camera_array(whole, center, device)
        self.rays.height, self.rays.width = height, width
        self.rays.tile_size = tile_size
        self.rays.rays_per_side = 1
        self.rays.exposures = wp.zeros((0, 0), dtype=wp.vec3, device=device)
        self.tile_total = count * -(-height // tile_size) * -(-width // tile_size)  # of all pictures
        # (tiles,) which of them count: a tile of weight 1/3 is one of three that are taken
        self.counted: np.ndarray | None = None
        if scene.weights is not None:
            least = tile_weights(scene.weights, tile_size)
            self.counted = least > np.random.default_rng(0).random(len(least), np.float32)
        self.active_tiles = self.batch_tiles = self.cursor = 0  # that see the field; per batch; where the next begins
        self.view_tiles = np.zeros(len(scene) + 1, np.int32)  # where each view's active tiles begin
        self.squared_error = wp.zeros(0, dtype=wp.float32, device=device)  # of a batch, summed over the channels
        self.pictures = TrainingPictures(scene, chosen_bits(scene, held + self.rays.cameras.capacity, limit), device)
        self.rays.pictures = self.pictures.seen

    def keep_pictures(self, bits: int) -> None:
        """Go on with the pictures at another precision, bits per channel, one of PRECISIONS."""
        if bits != self.pictures.bits:
            self.rays.pictures = Pictures()  # lets go of the ones before
            self.pictures.keep(bits)
            self.rays.pictures = self.pictures.seen

    @property
    def picture_rays(self) -> PictureRays:
        """What the pictures see, by the cameras as they are."""
        counted = None if self.counted is None else self.pictures.counted
        return PictureRays(self.rays.cameras, self.rays.width, self.rays.height, counted)

    @property
    def held_bytes(self) -> int:
        """Device memory of pictures, cameras, tiles and errors; of all tiles, where it is not known yet which count."""
        tiles = self.active_tiles or self.tile_total
        errors = ERROR_BYTES * self.squared_error.size
        return self.pictures.held_bytes + self.rays.cameras.capacity + TILE_BYTES * tiles + errors

    @property
    def mark_bytes(self) -> int:
        """Device memory of one number for each tile of the pictures, held while the active ones are found."""
        return TILE_BYTES * self.tile_total

    @property
    def batch_rays(self) -> int:
        """Rays per batch."""
        return self.batch_tiles * self.rays.tile_size**2

    def activate(self, field: VoxelField | None) -> None:
        """Find the tiles that see anything of a field, and shuffle them.
        field: None where all tiles count, as every pixel shows something."""
        tiles = self.counted_tiles if field is None else self._seeing(field)
        if len(tiles) == 0:
            raise InputError("no camera sees the bounds of the field: check the bounds and the cameras' axes")
        self.take(tiles)
        self.shuffle()

    @property
    def ignored_views(self) -> np.ndarray | None:
        """(views,) bool, the views of which nothing counts. None where all pixels count."""
        if self.counted is None:
            return None
        return np.asarray(~self.counted.reshape(self.rays.cameras.shape[0], -1).any(axis=1))

    @property
    def counted_tiles(self) -> np.ndarray:
        """(tiles,) int32 the tiles that count, whatever they see."""
        tiles = np.arange(self.tile_total, dtype=np.int32)
        return tiles if self.counted is None else tiles[self.counted]

    def _seeing(self, field: VoxelField) -> np.ndarray:
        """(tiles,) int32 the tiles that count, with a pixel that looks through a cell of a field."""
        active = wp.zeros(self.tile_total, dtype=wp.int32, device=self.device)
        inputs = [field.grid, self.rays.cameras, self.rays.tile_size, ACTIVE_STEP * field.step]
        launch(mark_active_tiles, self.tile_total, inputs, [active], device=self.device)
        seeing = active.numpy() > 0
        return np.flatnonzero(seeing if self.counted is None else seeing & self.counted).astype(np.int32)

    def size(self, batch_tiles: int) -> None:
        """Make batches of so many tiles from now on."""
        self.batch_tiles = batch_tiles
        self.squared_error = wp.zeros(self.batch_rays, dtype=wp.float32, device=self.device)

    def shuffle(self) -> None:
        """Another order of the active tiles, from its beginning."""
        self.order(int(self.random.integers(ORDERS)), 0)

    def take(self, tiles: np.ndarray) -> None:
        """Batches of these tiles, (tiles,) int32, from now on."""
        self.active_tiles = len(tiles)
        views = self.rays.cameras.shape[0]
        self.view_tiles = np.searchsorted(tiles, self.tile_total // views * np.arange(views + 1)).astype(np.int32)
        self.rays.tiles = wp.array(tiles, dtype=wp.int32, device=self.device)

    def order(self, key: int, cursor: int) -> None:
        """Go on in the order of a key, see kernels/fitting/batches; cursor: where the next batch begins."""
        self.rays.order = key
        self.cursor = cursor

    def advance(self, rays_per_side: int) -> None:
        """On to the next batch; rays_per_side: of a pixel."""
        if self.cursor + self.batch_tiles > self.active_tiles:
            self.shuffle()
        self.rays.first_tile = self.cursor
        self.rays.rays_per_side = rays_per_side
        self.cursor += self.batch_tiles

    def psnr(self) -> float:
        """PSNR in dB of the last batch over all pixels that count: those that see no voxel count as right."""
        side = self.rays.tile_size
        rows, columns = (np.minimum(side, n - np.arange(0, n, side)) for n in (self.rays.height, self.rays.width))
        pixels = np.tile(np.outer(rows, columns).ravel(), self.rays.cameras.shape[0])  # of each tile: less at the edges
        total = int(pixels.sum() if self.counted is None else pixels[self.counted].sum())
        error = float(self.squared_error.numpy().mean()) / 3.0 * self.active_tiles * side**2 / total
        return -10.0 * math.log10(max(error, MIN_ERROR))


#: Outputs of their own are worth their memory for up to this many CPU threads.
MAX_SHARDS = 8

#: Parts of a shard's work that one launch takes: an interrupt waits for it.
MAX_PARTS = 8192


def shard_count(device: wp.Device) -> int:
    """Shards of a fit on a device."""
    return min(cpu_threads(), MAX_SHARDS) if device.is_cpu else 1  # atomics of CPUs are plain reads and writes


@dataclasses.dataclass(frozen=True)
class ShardedWork:
    """A kernel to launch in shards."""

    kernel: Kernel  # its first parameter is `first`, the index of a shard's first item
    count: int  # parts of the work that stay together in one shard
    inputs: list  # what the kernel takes after `first`, the same for all shards
    outputs: Sequence[Sequence]  # what it then takes, for each shard
    items: int = 1  # items of the kernel per part


def launch_shards(works: Sequence[ShardedWork], shards: int, device: wp.Device) -> None:
    """Launch kernels one after another in each of several threads, which take one run of the parts of each work."""
    for work in works:  # before the threads, so that each module is compiled once
        require_loaded(work.kernel, device, module_block_dim(work.kernel))

    stopped = threading.Event()

    def run(shard: int) -> None:
        for work in works:
            first, last = (work.count * edge // shards for edge in (shard, shard + 1))
            most = MAX_PARTS if device.is_cpu else max(1, last - first)
            for part in range(first, last, most):
                if stopped.is_set():
                    return
                begin, end = (work.items * edge for edge in (part, min(part + most, last)))
                launch_off_tape(
                    work.kernel,
                    end - begin,
                    [begin, *work.inputs],
                    list(work.outputs[shard]),
                    device=device,
                    block_dim=module_block_dim(work.kernel),
                )

    with device_turn(device):
        run_parallel([lambda shard=shard: run(shard) for shard in range(shards)], shards, stopped.set)


#: Rays of a look at all pictures, at most: hundreds of pictures show what some of their pixels do.
MAX_LOOKS = 2e7


@dataclasses.dataclass(frozen=True)
class PictureRays:
    """The pixels of pictures of one size, through which a fit looks for what they show."""

    cameras: wp.array  # (views,) PinholeCamera
    width: int  # pixels
    height: int
    counted: wp.array | None = None  # (views, h, w) uint8, 0 for pixels that do not count; None counts all

    def stride(self, side: int) -> int:
        """Every how many rows and columns a look at all pictures has a ray. side: voxels along the longest side."""
        # a ray for each half voxel where the longest side of a box fills the shorter one of a picture
        shortest, rays = min(self.width, self.height), self.cameras.shape[0] * self.width * self.height
        return max(1, shortest // (2 * side), math.ceil(math.sqrt(rays / MAX_LOOKS)))

    def record(
        self, kernel: Kernel, inputs: list, stride: int, rows: int, shards: int, counts: wp.array | None = None
    ) -> wp.array:
        """(rows,) float32, the largest number that any ray gives to each row; rays: of every stride-th row and column.
        counts: (rows,) uint8, the number of pictures that show each row is added, up to 255."""
        device, views = wp.get_device(self.cameras.device), self.cameras.shape[0]
        found = [wp.zeros(rows, dtype=wp.float32, device=device) for _ in range(shards)]
        shown = wp.zeros((shards, 1 if counts is None else max(1, rows)), dtype=wp.uint32, device=device)
        outputs = [[found[shard], None if counts is None else shown[shard]] for shard in range(shards)]
        rays = -(-self.width // stride) * -(-self.height // stride)  # of a picture
        together = max(1, min(views if counts is None else MARKED_VIEWS, MAX_ITEMS // rays))
        for first in range(0, views, together):
            part = slice(first, min(first + together, views))
            counted = None if self.counted is None else self.counted[part]
            taken = [self.cameras[part], stride, counted, *inputs]
            work = ShardedWork(kernel, rays * (part.stop - first), taken, outputs)
            launch_shards([work], shards, device)
            if counts is not None:
                launch(count_marks, rows, [shown], [counts], device=device)
        for other in found[1:]:
            launch(join_maximum, rows, [other], [found[0]], device=device)
        return found[0]


#: Pictures that a row has marks of at a time; and how many a row's count ends at.
MARKED_VIEWS, MAX_VIEWS = 32, 255


class ViewCounts:
    """How many pictures show each row of a grid, and how much more total variation those get that few show."""

    def __init__(self, views: float, device: wp.Device):
        self.device, self.is_used = device, views > 0  # views: from so many on no more; 0 counts none
        factors = view_factors(views) if self.is_used else np.zeros((0, 2))
        self.factors = wp.array(factors, dtype=wp.vec2, device=device)  # on density and colors, by the number of views
        self.counts = wp.zeros(0, dtype=wp.uint8, device=device)  # (rows,), 255 at most; empty: not counted yet

    @property
    def held_bytes(self) -> int:
        """Device memory of the counts and factors."""
        return self.counts.size + 8 * self.factors.size

    def forget(self) -> None:
        """Without counts, as the rows change."""
        self.counts = wp.zeros(0, dtype=wp.uint8, device=self.device)

    def state(self, name: str) -> dict[str, np.ndarray]:
        """The counts under a name, for a checkpoint; nothing where none are used."""
        return {name: self.counts.numpy()} if self.is_used else {}

    def restore(self, contents: dict[str, np.ndarray], name: str, rows: int, path: pathlib.Path) -> None:
        """Take over the counts of so many rows, or that there are none yet, of a checkpoint's arrays."""
        self.forget()
        if self.is_used:
            counts = require_numbers(contents, name, (None,), path)
            if len(counts) not in (0, rows) or counts.min(initial=0) < 0 or counts.max(initial=0) > MAX_VIEWS:
                raise InputError(f"{len(counts)} numbers of views for {rows} voxels, or some that cannot be")
            self.counts = wp.array(counts.astype(np.uint8), dtype=wp.uint8, device=self.device)

    def begin(self, rows: int) -> wp.array | None:
        """Counts (rows,) uint8 of no picture so far, to be added to; None where none are used."""
        self.forget()
        if not self.is_used:
            return None
        self.counts = wp.zeros(rows, dtype=wp.uint8, device=self.device)
        return self.counts

    def take(self, counts: wp.array | None, rows: wp.array) -> None:
        """Those of rows (rows,) int32 among counts, if there are any."""
        if counts is not None and counts.size:
            self.counts = gathered(counts, rows)

    def follow(self, rows: wp.array) -> None:
        """Go on to rows, by which each was before (rows,) int32, if there are counts."""
        self.take(self.counts, rows)


def sum_shards(gradients: Sequence[wp.array]) -> wp.array:
    """Move the gradients of all shards, (numbers,) float32 each, into the first, and return it."""
    total, *others = gradients
    for other in others:
        launch(add_gradients, total.size, [other], [total], device=total.device)
    return total
