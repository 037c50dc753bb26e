"""Renderer: a thread that shows the newest document, quickly while the hand moves and sharply when it rests."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from ..field.voxel_field import VoxelField
from ..splats.splat_field import AnyField
from ..view.frame import Frame
from ..view.frame_parts import mask_shares
from .document import Document
from .effort import COARSE_CELLS, Effort, Pace
from .picture import (
    DEPTHS_MOVING,
    DEPTHS_SHARP,
    Pixels,
    band_camera,
    depth_size,
    frame_pixels,
    joined_pixels,
    packed_frame,
)
from .scene import PosedScene, camera

_log = logging.getLogger(__name__)

#: How long the hand must rest before a sharp picture is begun, seconds; longer where its pose takes long.
REST_SECONDS = 0.15

#: Seconds that a band of a sharp picture may take on a CPU, where nothing interrupts it.
BAND_SECONDS = 0.03

#: What may go wrong with a pose that somebody drags about. The picture before stays.
EXPECTED = (ValueError, MemoryError, RuntimeError, OverflowError)


@dataclasses.dataclass(frozen=True)
class Request:
    """A picture that is wanted, of so many pixels."""

    document: Document
    width: int
    height: int
    moving: bool  # whether the hand moves: the picture should come soon rather than be sharp
    applied: Mapping[int, int]  # the newest message of each page that it shows


class Superseded(Exception):
    """A newer picture is wanted."""


class Renderer:
    """Renders documents in a thread. Only the newest request counts: others that wait are forgotten.
    `deliver`: called with the header and the message of each frame, from a thread of the renderer."""

    def __init__(self, field: AnyField, deliver: Callable[[dict[str, Any], bytes], None]):
        self._scene = PosedScene(field)
        self._field, self._deliver = field, deliver
        self.pace = Pace(not field.device.is_cpu)
        self.frames = 0  # that were delivered
        self._changed = threading.Condition()
        self._wanted: Request | None = None
        self._closed = False
        self._times: list[float] = []
        self._warm: set[tuple[Any, ...]] = set()
        self._held: tuple[Document, int] | None = None  # what is posed, and with how many cells
        self._encoder = concurrent.futures.ThreadPoolExecutor(1, "warpcage-jpeg")
        self._sent: concurrent.futures.Future | None = None
        self._thread = threading.Thread(target=self._run, name="warpcage-renderer", daemon=True)
        self._thread.start()

    def request(self, request: Request) -> None:
        """Want another picture; what was wanted before is not, unless it is being made."""
        with self._changed:
            self._wanted = request
            self._changed.notify()

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
                sharp = not request.moving and self._sharp_seconds(request) < 0.1
            rough = None if sharp else request
            try:
                self._show(request, sharp)
            except Superseded:
                rough = None  # the newer request comes next
            except EXPECTED as error:
                rough = None
                self._complain(request, error)
            except Exception as error:  # a mistake of ours, or a kernel that cannot be built: the next one may do
                rough = None
                _log.exception("a picture could not be made")
                self._complain(request, error)

    def _next(self, timeout: float | None) -> Request | None:
        """The newest request, once there is one; None when the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._wanted is not None or self._closed, timeout)
            request, self._wanted = self._wanted, None
            return request

    def _rest_seconds(self, request: Request) -> float:
        """How long to wait for a newer request before a sharp picture is begun."""
        if not request.moving:
            return 0.0
        settings = request.document.settings
        return max(REST_SECONDS, self.pace.pose_seconds(settings.coordinates, settings.resolution))

    def _sharp_seconds(self, request: Request) -> float:
        return self.pace.sharp_seconds(self._sharp_effort(request), request.document.settings.coordinates)

    def _sharp_effort(self, request: Request) -> Effort:
        settings = request.document.settings
        return self.pace.sharp(request.width, request.height, settings.resolution, settings.supersampling)

    def _show(self, request: Request, sharp: bool) -> None:
        settings = request.document.settings
        if sharp:
            effort = self._sharp_effort(request)
        else:
            posing = self._held is None or not same_pose(self._held[0], request.document)
            effort = self.pace.moving(request.width, request.height, settings.resolution, settings.coordinates, posing)
        self._warm_up(request.document, effort)
        started = time.perf_counter()
        held, self._held = self._held, None
        fresh = held is None or held[1] != effort.cells or not same_pose(held[0], request.document)
        self._scene.prepare(request.document, effort.cells)
        if fresh:
            wp.synchronize_device(self._field.device)
        self._held = (request.document, effort.cells)
        posed = time.perf_counter()
        pixels, shares = self._pixels(request, effort)
        done = time.perf_counter()
        self.pace.learn(effort, settings.coordinates, posed - started if fresh else None, done - posed)
        self.frames += 1
        self._times = [when for when in self._times if done - when < 1.0] + [done]
        view = request.document.view
        header = {
            "frame": self.frames,
            "applied": {str(client): number for client, number in request.applied.items()},
            "width": effort.width,
            "height": effort.height,
            "view": dataclasses.asdict(view),
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
        self._send(header, pixels, effort.quality, started)

    def _warm_up(self, document: Document, effort: Effort) -> None:
        """Load the kernels of a kind of coordinates before anything is timed: the first time they are compiled."""
        kind = (document.settings.coordinates, bool(document.edits), effort.supersampling > 1)
        if kind in self._warm:
            return
        scene = PosedScene(self._field)
        scene.prepare(document, COARSE_CELLS[0])
        frame = scene.render(camera(document.view, 16, 12), None, None, effort.supersampling)
        frame_pixels(frame, "rgb", *self._depth_range(document), 16, 12)
        self._warm.add(kind)

    def _pixels(self, request: Request, effort: Effort) -> tuple[Pixels, dict[str, float] | None]:
        """The pixels of a picture, and for a sharp one what its masks mark."""
        document = request.document
        whole = camera(document.view, effort.width, effort.height)
        near, far = self._depth_range(document)
        columns, depths = depth_size(effort.width, effort.height, DEPTHS_SHARP if effort.sharp else DEPTHS_MOVING)
        rows = effort.height
        # a band of splats takes about as long as all of the picture, and filling needs the whole picture
        banded = isinstance(self._field, VoxelField) and not self._fills(document)
        if effort.sharp and self._field.device.is_cpu and banded:
            seconds = self.pace.sharp_seconds(effort, document.settings.coordinates)
            rows = max(8, math.ceil(effort.height / max(1.0, seconds / BAND_SECONDS)))
        bands, shares = [], []
        for first in range(0, effort.height, rows):
            if effort.sharp and self._wanted is not None:
                raise Superseded
            last = min(first + rows, effort.height)
            frame = self._frame(document, band_camera(whole, first, last), effort)
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

    def _frame(self, document: Document, seen: Any, effort: Effort) -> Frame:
        field = self._field
        step = effort.step * field.step if effort.step != 1.0 and isinstance(field, VoxelField) else None
        fill = effort.sharp and self._fills(document)
        return self._scene.render(seen, document.settings.background, step, effort.supersampling, fill)

    def _fills(self, document: Document) -> bool:
        """Whether background is filled in sharp pictures of a document."""
        settings = document.settings
        return settings.fill and settings.background is None and self._field.background_model is not None

    def _depth_range(self, document: Document) -> tuple[float, float]:
        """Distances between which matter is expected, world units."""
        low, high = self._field.bounds
        distance = float(np.linalg.norm(np.asarray(document.view.eye) - (low + high) / 2))
        reach = 2.0 * float(np.linalg.norm(high - low))
        return max(distance - reach, 1e-3 * (distance + reach)), distance + reach

    def _complain(self, request: Request, error: Exception) -> None:
        """Tell pages why there is no picture."""
        self.frames += 1
        text = " ".join(str(error).split()) or type(error).__name__
        header = {
            "frame": self.frames,
            "applied": {str(client): number for client, number in request.applied.items()},
            "view": dataclasses.asdict(request.document.view),
            "sharp": False,
            "error": text,
        }
        self._send(header, None, 0, time.perf_counter())

    def _send(self, header: dict[str, Any], pixels: Pixels | None, quality: int, started: float) -> None:
        """Encode and deliver in another thread, while the next picture is made. One waits at most."""
        if self._sent is not None and (error := self._sent.exception()) is not None:
            _log.error("a picture could not be sent", exc_info=error)

        def send() -> None:
            if "ms" in header:
                header["ms"]["all"] = 1e3 * (time.perf_counter() - started)
            self._deliver(header, packed_frame(header, pixels, quality))

        self._sent = self._encoder.submit(send)


def same_pose(one: Document, two: Document) -> bool:
    """Whether two documents pose the scene alike. They share what did not change, so a look at each array is enough."""
    options = ("mode", "coordinates", "density")
    return (
        all(getattr(one.settings, name) == getattr(two.settings, name) for name in options)
        and len(one.edits) == len(two.edits)
        and all(
            a.posed is b.posed
            and a.rest is b.rest
            and (a.kind, a.visible, a.falloff, a.held, a.crumbs) == (b.kind, b.visible, b.falloff, b.held, b.crumbs)
            for a, b in zip(one.edits, two.edits, strict=True)
        )
    )
