"""Kernels that are launched again and again: what changes between launches is seen, and nothing else stays."""

import functools
import gc
import threading
import weakref

import numpy as np
import pytest
import warp as wp

from warpcage.core import RecordedLaunch, RecordedLaunches, kernel_label, launch, recorded_launches
from warpcage.kernels.field.march import image_kernel
from warpcage.kernels.render.views import part_kernel, stack_kernel
from warpcage.kernels.view.tile_order import sort_tiles

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Line:
    slope: float
    values: wp.array(dtype=float)


@wp.kernel
def follow_line(first: int, line: Line, shift: wp.vec3, begin: float, found: wp.array(dtype=float)):
    n = first + wp.tid()
    found[n] = begin + line.slope * line.values[n] + shift[0] * shift[1] * shift[2]


@wp.kernel
def fill_with(first: int, value: int, found: wp.array(dtype=wp.int32)):
    found[first + wp.tid()] = value


def line_of(values, slope, device):
    line = Line()
    line.slope, line.values = slope, wp.array(values, dtype=float, device=device)
    return line


def test_follows_what_changes(device):
    """Numbers, vectors, arrays, structs that are other objects, structs that hold something else, and counts."""
    random = np.random.default_rng(0)
    repeated = RecordedLaunch(follow_line, device)
    line, found = line_of(np.arange(9.0), 2.0, device), wp.zeros(9, dtype=float, device=device)
    shift, begin, count = wp.vec3(1.0, 2.0, 3.0), 1.0, 9
    for turn in range(60):
        change = random.integers(8)
        if change == 0:
            begin = float(turn)
        elif change == 1:
            shift = wp.vec3(*random.integers(0, 9, 3).astype(float).tolist())
        elif change == 2:
            line = line_of(random.integers(0, 9, 9), float(turn), device)
        elif change == 3:
            line.slope = float(turn)
        elif change == 4:
            line.values = wp.array(random.integers(0, 9, 9), dtype=float, device=device)
        elif change == 5:
            found = wp.zeros(9, dtype=float, device=device)
        elif change == 6:
            count = int(random.integers(0, 10))
        expected = found.numpy()
        expected[:count] = (begin + line.slope * line.values.numpy() + shift[0] * shift[1] * shift[2])[:count]
        repeated(count, [line, shift, begin], [found])
        assert np.array_equal(found.numpy(), expected), turn


def test_goes_on_after_one_that_failed(device):
    """Of a launch that ended before it was made, nothing is left."""
    repeated, found = RecordedLaunch(follow_line, device), wp.zeros(4, dtype=float, device=device)
    line, other = (line_of([0.0, 1, 2, 3], slope, device) for slope in (1.0, 5.0))
    none = wp.vec3(0.0, 0.0, 0.0)
    repeated(4, [line, none, 0.0], [found])
    with pytest.raises(Exception, match="found|array|type"):
        repeated(4, [other, none, 7.0], ["no array"])
    repeated(4, [line, none, 0.0], [found])
    assert found.numpy().tolist() == [0.0, 1.0, 2.0, 3.0]


def test_keeps_nothing_alive_that_passes(device):
    repeated, line, none = RecordedLaunch(follow_line, device), line_of([2.0, 3], 1.0, device), wp.vec3(0.0, 0.0, 0.0)
    for begin in (0.0, 1.0, 1.0, 5.0):
        found = wp.zeros(2, dtype=float, device=device)
        alive = weakref.ref(found)
        repeated(2, [line, none, begin], [found], transient=2)
        assert found.numpy().tolist() == [begin + 2.0, begin + 3.0]
        del found
        gc.collect()
        assert alive() is None


def test_launches_in_turn_keep_their_own_arguments(device):
    """Two that repeat, one between them, and two of an owner by number; counts go up and down."""
    owner, none = RecordedLaunches(device), wp.vec3(0.0, 0.0, 0.0)
    ways = [RecordedLaunch(follow_line, device), functools.partial(launch, follow_line, device=device),
            RecordedLaunch(follow_line, device), functools.partial(owner, follow_line, number=0),
            functools.partial(owner, follow_line, number=1)]  # fmt: skip
    found = [wp.zeros(5, dtype=float, device=device) for _ in ways]
    lines = [line_of(np.arange(5.0), 1.0 + number, device) for number in range(len(ways))]
    for turn, count in enumerate((3, 5, 0, 2)):
        for way, line, array in zip(ways, lines, found, strict=True):
            array.fill_(-1.0)
            way(count, [line, none, float(turn)], [array])
        for line, array in zip(lines, found, strict=True):
            expected = np.where(np.arange(5) < count, turn + line.slope * np.arange(5.0), -1.0)
            assert np.array_equal(array.numpy(), expected)


def test_labels_of_kernels_and_of_variants():
    kernels = [sort_tiles, part_kernel(True, False), stack_kernel(True), image_kernel(False), follow_line]
    expected = ["tile_order.sort_tiles", "views.shaded+part", "views.stack+simple", "march.rows"]
    assert [kernel_label(kernel) for kernel in kernels] == [*expected, "test_repeated_launch.follow_line"]


def test_records_what_is_launched(device):
    """Once each, in their order, by any launcher and in any number of parts, but not empty launches."""
    line, none = line_of(np.arange(1000.0), 1.0, device), wp.vec3(0.0, 0.0, 0.0)
    found, order = wp.zeros(1000, dtype=float, device=device), wp.zeros(4, dtype=wp.int32, device=device)
    label, repeated = "test_repeated_launch.follow_line", RecordedLaunch(follow_line, device)
    inputs = [line, none, 0.0]
    launch(follow_line, 1000, inputs, [found], device=device)
    with recorded_launches() as launched:
        launch(follow_line, 1000, inputs, [found], device=device, threads=4, work=1e6)
        launch(follow_line, 0, inputs, [found], device=device)
        for _ in range(2):
            repeated(1000, inputs, [found])
        repeated(0, inputs, [found])
        assert launched == 3 * [label]
        with recorded_launches() as inner:
            launch(fill_with, 4, [7], [order], device=device)
        repeated(1000, inputs, [found])
    launch(follow_line, 1000, inputs, [found], device=device)
    assert inner == ["test_repeated_launch.fill_with"] and launched == [*(3 * [label]), *inner, label]


def test_records_of_threads_hold_the_launches_of_all(device):
    """Records begin and end while other threads launch; each holds at least what its own thread launched."""
    records, begin = {}, threading.Barrier(4)

    def work(number):
        order = wp.zeros(4, dtype=wp.int32, device=device)
        begin.wait()
        for turn in range(20):
            with recorded_launches() as launched:
                launch(fill_with, 4, [turn], [order], device=device)
            records[number, turn] = launched

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(records) == 80 and all(records.values())
    assert {label for each in records.values() for label in each} == {"test_repeated_launch.fill_with"}
    with recorded_launches() as launched:
        pass
    assert launched == []
