# pyright: strict
"""A program of somebody's who moves points and fields of several libraries, under strict rules. Nothing here is run."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Iterator

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import assert_type

from warpcage import Cage, Deformer, PositionMap, VoxelField, deform_points, turntable


class Cloud:
    """Points in single precision, and where a cage takes them."""

    def __init__(self, points: NDArray[np.float32], rest: Cage) -> None:
        self.points, self.rest = points, rest

    def moved(self, posed: Cage | NDArray[np.float64]) -> Cloud:
        return Cloud(deform_points(self.points, self.rest, posed), self.rest)

    def spread(self) -> float:
        return float(np.ptp(self.points))


class Shared:
    """An array of a library that speaks DLPack."""

    def __dlpack__(self, stream: int | None = None) -> object:
        return np.zeros((4, 3)).__dlpack__()


def kinds(cage: Cage, posed: NDArray[np.float64], on_device: wp.array[wp.vec3], anything: ArrayLike) -> None:
    assert_type(deform_points(np.zeros((4, 3), np.float32), cage, posed), NDArray[np.float32])
    assert_type(deform_points(cage.vertices.astype(np.float64), cage, posed), NDArray[np.float64])
    assert_type(deform_points(np.zeros((4, 3), np.int64), cage, cage, "green"), NDArray[np.float64])
    assert_type(deform_points([[0.0, 0.0, 0.0]], cage, cage, outside="nan"), NDArray[np.float64])
    assert_type(deform_points(Shared(), cage, posed, device="cpu"), Shared)
    moved: wp.array[wp.vec3] = deform_points(on_device, cage, on_device)
    print(len(moved), deform_points(anything, cage, posed))


def poses(cage: Cage, count: int) -> Iterator[NDArray[np.float64]]:
    for number in range(count):
        vertices: NDArray[np.float64] = np.asarray(cage.twist(10 * number).vertices)
        yield vertices


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("field", type=pathlib.Path)
    field = VoxelField.load(parser.parse_args().field)
    cage = Cage.from_field(field)
    deformer, places = Deformer(field, cage), PositionMap(cage, resolution=64)
    cloud = Cloud(np.asarray(cage.vertices, np.float32), cage)
    for vertices in poses(cage, 3):
        frames = deformer.pose(vertices).render(turntable((0, 0, 0), 4, 20, 6, width=64, height=64))
        places.pose(vertices)
        print(frames.rgb.shape, cloud.moved(vertices).spread())
    return 0
