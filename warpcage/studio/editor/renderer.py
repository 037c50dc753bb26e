"""Pictures of a document, from a thread of their own: only the newest request counts."""

from __future__ import annotations

import collections
import concurrent.futures
import dataclasses
import json
import logging
import math
import struct
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import warp as wp

from ...core.arrays import empty_array
from ...core.devices import launch
from ...core.names import coordinate_kind
from ...core.threads import device_turn
from ...field.voxel_field import VoxelField
from ...kernels.view import pictures
from ...splats.splat_field import AnyField
from ...view.camera import Camera
from ...view.frame import Frame
from ...view.frame_parts import mask_shares, picture
from ..films.document import Document
from ..films.render import Look
from ..films.session.scene import HIDING_ALPHA, Fields, PosedScene, is_filled, same_pose, view_camera
from ..spec.settings import Background

#: Seconds that a picture may take during a drag, on a CPU and on CUDA.
MOVING_SECONDS = {"cpu": 0.05, "cuda": 0.022}

#: Cells of lattices that are tried on a CPU during a drag, and the least side of a picture, pixels.
COARSE_CELLS = (16, 20, 24, 32, 48, 64, 96, 128)

MIN_SIDE = 200

#: March steps that are taken as one on a CPU during a drag.
MOVING_STEP = {"cpu": 3.0, "cuda": 1.0}

#: Quality of JPEGs during a drag, of pictures with few pixels then, which the page enlarges, and at rest.
MOVING_QUALITY, SMALL_QUALITY, SHARP_QUALITY = 75, 90, 92

SMALL_PIXELS = 100_000

#: How much a new measurement counts, and how far pictures may be off before their size changes.
LEARNING, SLACK = 0.35, 1.25

#: What a first guess says, on a CPU: seconds per cell of a lattice to the power of 2.5, and per pixel.
FIRST_POSE, FIRST_PIXEL = 3e-6, 2e-6


@dataclasses.dataclass(frozen=True)
class Effort:
    """What goes into one picture."""

    width: int  # of the picture, pixels; so is the height
    height: int
    cells: int  # of the lattices along the longest side of a cage
    step: float  # march steps of the field that are taken as one
    supersampling: int  # rays along each side of a pixel
    quality: int  # of the JPEG
    sharp: bool  # whether it is as good as the settings ask for


class Pace:
    """What poses and pixels cost on this machine, measured as pictures are made."""

    def __init__(self, cuda: bool):
        self.kind = "cuda" if cuda else "cpu"
        self._pose: dict[tuple[str, int], float] = {}  # (coordinates, cells) -> seconds
        self._pixel = {True: FIRST_PIXEL, False: 3.0 * FIRST_PIXEL}  # sharp -> seconds, supersampling left out
        self._scale = 0.0  # of the last picture during a drag

    def learn(self, effort: Effort, coordinates: str, pose: float | None, render: float) -> None:
        """Take in what a picture took, seconds for the pose (None: it was there already) and for the pixels."""
        if pose is not None:
            key = (coordinates, effort.cells)
            self._pose[key] = _mixed(self._pose.get(key), pose)
        pixels = effort.width * effort.height * effort.supersampling**2
        self._pixel[effort.sharp] = _mixed(self._pixel[effort.sharp], render / pixels)

    def pose_seconds(self, coordinates: str, cells: int) -> float:
        """What a pose is thought to take, by the nearest lattice that was measured."""
        known = [(abs(math.log(cells / c)), c, t) for (kind, c), t in self._pose.items() if kind == coordinates]
        if not known:
            return FIRST_POSE * cells**2.5 * (2.0 if coordinate_kind(coordinates).is_closed_form else 1.0)
        _, near, seconds = min(known)
        return seconds * (cells / near) ** 2.5

    def sharp_seconds(self, effort: Effort, coordinates: str) -> float:
        """What a sharp picture is thought to take."""
        pixels = effort.width * effort.height * effort.supersampling**2
        return self.pose_seconds(coordinates, effort.cells) + pixels * self._pixel[True]

    def moving(self, width: int, height: int, cells: int, coordinates: str, posing: bool) -> Effort:
        """A picture that is ready in time during a drag, of at most so many pixels (but MIN_SIDE) and cells.
        `posing`: whether the pose changes, not the view alone."""
        budget = MOVING_SECONDS[self.kind]
        if self.kind == "cpu":
            good = [c for c in COARSE_CELLS if c <= cells and self.pose_seconds(coordinates, c) < 0.4 * budget]
            cells = min(cells, good[-1] if good else COARSE_CELLS[0])
        left = budget - (self.pose_seconds(coordinates, cells) if posing and self._pose else 0.0)
        scale = math.sqrt(max(left, 0.2 * budget) / self._pixel[False] / (width * height))
        least = min(1.0, MIN_SIDE / max(width, height))
        scale = min(1.0, max(scale, least))
        if self._scale and max(scale / self._scale, self._scale / scale) < SLACK and scale < 1.0:
            scale = max(self._scale, least)  # a size that flickers disturbs more than a few pixels
        self._scale = min(1.0, scale)
        size = max(1, round(width * self._scale)), max(1, round(height * self._scale))
        quality = SMALL_QUALITY if size[0] * size[1] < SMALL_PIXELS else MOVING_QUALITY
        return Effort(*size, cells, MOVING_STEP[self.kind], 1, quality, False)


def _mixed(known: float | None, seen: float) -> float:
    return seen if known is None else (1.0 - LEARNING) * known + LEARNING * seen


#: The first number of a frame's message; see `packed_frame`.
FRAME = 10

#: Depths along the longest side of a picture, during a drag and at rest.
DEPTHS_MOVING, DEPTHS_SHARP = 64, 256


@dataclasses.dataclass(frozen=True)
class Pixels:
    """A frame on the host, as it is sent."""

    colors: np.ndarray  # (h, w, 3) uint8
    depths: np.ndarray  # (rows, columns) uint16, see kernels/view/pictures.py
    near: float  # distances that the depths 1 and 65535 stand for, world units
    far: float


def depth_size(width: int, height: int, depths: int) -> tuple[int, int]:
    """Columns and rows of depths for a picture, of which the longest side has at most `depths`."""
    share = min(1.0, depths / max(width, height))
    return max(1, round(width * share)), max(1, round(height * share))


def frame_pixels(frame: Frame, show: str, near: float, far: float, columns: int, rows: int) -> Pixels:
    """What is sent of a frame, whose arrays are on a device: `show` is one of SHOWN.
    `near` and `far`: distances that the depths 1 and 65535 stand for, world units."""
    rgb = frame.arrays["rgb"]
    width, height = frame.width, frame.height
    with device_turn(rgb.device):
        sampled = empty_array(rows * columns, wp.uint16, rgb.device)
        inputs = [width, height, columns, rows, HIDING_ALPHA, near, far, frame.arrays["alpha"], frame.arrays["depth"]]
        launch(pictures.sample_depths, rows * columns, inputs, [sampled], device=rgb.device)
        if show == "rgb":
            packed = empty_array((width * height, 3), wp.uint8, rgb.device)
            launch(pictures.pack_colors, width * height, [rgb], [packed], device=rgb.device)
            colors = packed.numpy().reshape(height, width, 3)
        else:
            shown = picture(frame, "rgb" if show == "masks" and frame.reveal is None else show)
            shown = np.repeat(shown[..., None], 3, axis=-1) if shown.ndim == 2 else shown
            colors = (np.clip(shown, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        return Pixels(np.ascontiguousarray(colors), sampled.numpy().reshape(rows, columns), near, far)


def joined_pixels(bands: list[Pixels]) -> Pixels:
    """Bands of one picture, from the top, as one."""
    colors, depths = (np.concatenate([getattr(band, name) for band in bands]) for name in ("colors", "depths"))
    return Pixels(colors, depths, bands[0].near, bands[0].far)


def band_camera(camera: Camera, first: int, last: int) -> Camera:
    """The camera of some rows of a picture, of which `last` is the first that is left out."""
    return dataclasses.replace(camera, cy=camera.cy - first, height=last - first)


def packed_frame(header: dict[str, Any], pixels: Pixels | None, quality: int) -> bytes:
    """A frame's message: four little-endian uint32 (FRAME, bytes of the header, of the JPEG, of the depths), then those
    three. Each but the last is padded to a multiple of 8. pixels None: there is only something to say."""
    import simplejpeg

    jpeg, depths = b"", b""
    if pixels is not None:
        sampling = "444" if quality >= 90 else "420"  # from 90 on colours keep their full resolution
        jpeg = simplejpeg.encode_jpeg(pixels.colors, quality=quality, colorspace="RGB", colorsubsampling=sampling)
        depths = pixels.depths.astype("<u2").tobytes()
    encoded = json.dumps(header, allow_nan=False).encode()
    parts = [struct.pack("<4I", FRAME, len(encoded), len(jpeg), len(depths))]
    parts += [encoded, b" " * (-len(encoded) % 8), jpeg, b"\0" * (-len(jpeg) % 8), depths]
    return b"".join(parts)


_log = logging.getLogger(__name__)

#: How long nothing must move before a sharp picture is begun, seconds; longer where its pose takes long.
REST_SECONDS = 0.15

#: Seconds that a band of a sharp picture may take on a CPU, where nothing interrupts it.
BAND_SECONDS = 0.03

#: What may go wrong with a pose during a drag. The picture before stays.
EXPECTED = (ValueError, MemoryError, RuntimeError, OverflowError)


@dataclasses.dataclass(frozen=True)
class Request:
    """A picture that is wanted, of so many pixels."""

    document: Document
    width: int
    height: int
    moving: bool  # whether something is being dragged: the picture should come soon rather than be sharp
    applied: Mapping[int, int]  # the newest message of each page that it shows
    ground: Background = None  # in place of a field's own background of one colour, here and not in films


Answer = TypeVar("Answer")


def _sharp_effort(request: Request) -> Effort:
    """The picture that the settings ask for."""
    settings = request.document.settings
    return Effort(request.width, request.height, settings.resolution, 1.0, settings.supersampling, SHARP_QUALITY, True)


class Superseded(Exception):
    """A newer picture is wanted."""


class Renderer:
    """Renders documents in a thread. Only the newest request counts: others that wait are forgotten.
    `deliver`: called with the header and the message of each frame, from a thread of the renderer."""

    def __init__(self, fields: AnyField | Fields, deliver: Callable[[dict[str, Any], bytes], None]):
        self._fields = Fields.of(fields)
        self._scene = PosedScene(self._fields)
        self._field, self._deliver = self._fields.main, deliver
        self.pace = Pace(not self._field.device.is_cpu)
        self.frames = 0  # that were delivered
        self._changed = threading.Condition()
        self._wanted: Request | None = None
        self._questions: collections.deque[Callable[[], None]] = collections.deque()
        self._closed = False
        self._times: list[float] = []
        self._warm: set[tuple[Any, ...]] = set()
        self._encoder = concurrent.futures.ThreadPoolExecutor(1, "warpcage-jpeg")
        self._sent: concurrent.futures.Future | None = None
        self._thread = threading.Thread(target=self._run, name="warpcage-renderer", daemon=True)
        self._thread.start()

    def request(self, request: Request) -> None:
        """Want another picture; what was wanted before is not, unless it is being made."""
        with self._changed:
            self._wanted = request
            self._changed.notify()

    def ask(self, question: Callable[[PosedScene], Answer]) -> concurrent.futures.Future[Answer]:
        """Ask the scene of the last picture something, in the renderer's thread, once the present picture is done."""
        answer: concurrent.futures.Future[Answer] = concurrent.futures.Future()

        def work() -> None:
            try:
                answer.set_result(question(self._scene))
            except BaseException as error:  # goes on in the thread that asked
                answer.set_exception(error)

        with self._changed:
            self._questions.append(work)
            self._changed.notify()
        return answer

    def close(self) -> None:
        """End the thread once its picture is done."""
        with self._changed:
            self._closed = True
            self._wanted = None
            self._changed.notify()
        self._thread.join()
        self._encoder.shutdown()

    def _run(self) -> None:
        rough: Request | None = None  # what is shown, not sharply
        while True:
            request = self._next(None if rough is None else self._rest_seconds(rough))
            if self._closed:
                return
            if request is None:
                assert rough is not None
                request, sharp = rough, True
            else:
                coordinates = request.document.settings.coordinates
                sharp = not request.moving and self.pace.sharp_seconds(_sharp_effort(request), coordinates) < 0.1
            rough = None if sharp else request
            try:
                self.show(request, sharp)
            except Superseded:
                rough = None  # the newer request comes next
            except Exception as error:
                rough = None
                if not isinstance(error, EXPECTED):  # a mistake of ours, or a kernel that cannot be built
                    _log.exception("a picture could not be made")
                text = " ".join(str(error).split()) or type(error).__name__
                self._send(request, {"sharp": False, "error": text}, None, 0, time.perf_counter())

    def _next(self, timeout: float | None) -> Request | None:
        """The newest request, once there is one and questions are answered; None when the time is over."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted or self._questions or self._closed, timeout)
                if self._closed or not self._questions:
                    request, self._wanted = self._wanted, None
                    return request
                question = self._questions.popleft()
            question()

    def _rest_seconds(self, request: Request) -> float:
        """How long to wait for a newer request before a sharp picture is begun."""
        if not request.moving:
            return 0.0
        settings = request.document.settings
        return max(REST_SECONDS, self.pace.pose_seconds(settings.coordinates, settings.resolution))

    def show(self, request: Request, sharp: bool) -> None:
        """Render a picture and deliver it, in the renderer's thread."""
        settings, held = request.document.settings, self._scene.held
        if sharp:
            effort = _sharp_effort(request)
        else:
            posing = held is None or not same_pose(held[0], request.document)
            effort = self.pace.moving(request.width, request.height, settings.resolution, settings.coordinates, posing)
        self._warm_up(request.document, effort)
        started = time.perf_counter()
        fresh = held is None or held[1] != effort.cells or not same_pose(held[0], request.document)
        self._scene.prepare(request.document, effort.cells)
        if fresh:
            wp.synchronize_device(self._field.device)
        posed = time.perf_counter()
        pixels, shares = self._pixels(request, effort)
        done = time.perf_counter()
        self.pace.learn(effort, settings.coordinates, posed - started if fresh else None, done - posed)
        self._times = [when for when in self._times if done - when < 1.0] + [done]
        header = {
            "width": effort.width,
            "height": effort.height,
            "objects": [one.id for one in request.document.objects],
            "sharp": effort.sharp,
            "scale": effort.width / request.width,
            "quality": effort.quality,
            "cells": effort.cells,
            "ms": {"pose": 1e3 * (posed - started), "render": 1e3 * (done - posed)},
            "depth": {"width": pixels.depths.shape[1], "height": pixels.depths.shape[0]}
            | {"near": pixels.near, "far": pixels.far},
            "masks": shares,
            "fps": len(self._times),
            "error": None,
        }
        self._send(request, header, pixels, effort.quality, started)

    def _warm_up(self, document: Document, effort: Effort) -> None:
        """Load the kernels of a kind of coordinates before anything is timed: the first time they are compiled."""
        kind = (document.settings.coordinates, bool(document.edits), effort.supersampling > 1, document.is_staged)
        if kind in self._warm:
            return
        scene = PosedScene(self._fields)
        scene.prepare(document, COARSE_CELLS[0])
        frame = scene.render(view_camera(document.view, 16, 12), Look(supersampling=effort.supersampling))
        frame_pixels(frame, "rgb", *self._depth_range(document), 16, 12)
        self._warm.add(kind)

    def _pixels(self, request: Request, effort: Effort) -> tuple[Pixels, dict[str, float] | None]:
        """The pixels of a picture, and for a sharp one what its masks mark."""
        document = request.document
        whole = view_camera(document.view, effort.width, effort.height)
        near, far = self._depth_range(document)
        columns, depths = depth_size(effort.width, effort.height, DEPTHS_SHARP if effort.sharp else DEPTHS_MOVING)
        rows = effort.height
        # a band of splats takes about as long as all of the picture, and filling needs the whole picture
        voxels = all(isinstance(self._fields.field(one), VoxelField) for one in document.objects if one.visible)
        banded = voxels and not is_filled(document, self._field)
        if effort.sharp and self._field.device.is_cpu and banded:
            seconds = self.pace.sharp_seconds(effort, document.settings.coordinates)
            rows = max(8, math.ceil(effort.height / max(1.0, seconds / BAND_SECONDS)))
        bands, shares = [], []
        for first in range(0, effort.height, rows):
            if effort.sharp and self._wanted is not None:
                raise Superseded
            last = min(first + rows, effort.height)
            frame = self._frame(request, band_camera(whole, first, last), effort)
            # bands together have as many rows of depths as the whole: a page takes them for those of one picture
            rows_of_depths = round(last * depths / effort.height) - round(first * depths / effort.height)
            bands.append(frame_pixels(frame, document.settings.show, near, far, columns, rows_of_depths))
            shares.append((last - first, mask_shares(frame) if effort.sharp else {}))
        if not effort.sharp or not shares[0][1]:
            return joined_pixels(bands), None
        names = shares[0][1]
        return joined_pixels(bands), {
            name: sum(count * share[name] for count, share in shares) / effort.height for name in names
        }

    def _frame(self, request: Request, seen: Any, effort: Effort) -> Frame:
        document = request.document
        background = document.settings.background
        fields = [self._fields.field(one) for one in document.objects if one.visible]
        if background is None and all(field.background_model is None for field in fields):
            background = request.ground
        fill = effort.sharp and is_filled(document, self._field)
        chosen = {"background": background, "supersampling": effort.supersampling, "step_scale": effort.step}
        return self._scene.render(seen, Look.of(document.settings, **chosen, fill=fill))

    def _depth_range(self, document: Document) -> tuple[float, float]:
        """Distances between which matter is expected, world units."""
        low, high = self._fields.bounds(document) if document.is_staged else self._field.bounds
        distance = float(np.linalg.norm(np.asarray(document.view.eye) - (low + high) / 2))
        reach = 2.0 * float(np.linalg.norm(high - low))
        return max(distance - reach, 1e-3 * (distance + reach)), distance + reach

    def _send(
        self, request: Request, header: dict[str, Any], pixels: Pixels | None, quality: int, started: float
    ) -> None:
        """Encode and deliver in another thread, while the next picture is made. One waits at most."""
        self.frames += 1
        applied = {str(client): number for client, number in request.applied.items()}
        header |= {"frame": self.frames, "applied": applied, "view": dataclasses.asdict(request.document.view)}
        if self._sent is not None and (error := self._sent.exception()) is not None:
            _log.error("a picture could not be sent", exc_info=error)

        def send() -> None:
            if "ms" in header:
                header["ms"]["all"] = 1e3 * (time.perf_counter() - started)
            self._deliver(header, packed_frame(header, pixels, quality))

        self._sent = self._encoder.submit(send)
