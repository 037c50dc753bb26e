"""Threads that share objects, launches that are interrupted, and kernel files that are damaged."""

import itertools
import os
import pathlib
import re
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import warp as wp
from fields import BOX, KINDS, MARCHES, shiny_field, use_march, view
from messages import MESSAGES
from refusals import refused
from runs import SUPPORT

from warpcage import CageEdit, Deformer, PositionMap, Scene, bake, deform_points, fit, turntable
from warpcage.core import (
    PART_SECONDS,
    RecordedLaunch,
    device_turn,
    launch,
    limit_threads,
    modules,
    owner_lock,
    run_parallel,
    run_parts,
)
from warpcage.deform import exact
from warpcage.edits import maps
from warpcage.errors import StateError
from warpcage.kernels.edits.structs import LatticeEdit
from warpcage.kernels.fitting.rmsprop import add_gradients
from warpcage.kernels.view.pictures import average_values
from warpcage.render import scene as lattice_edits

#: Where processes that tests start find helpers and this file.
MODULES = os.pathsep.join([SUPPORT, str(pathlib.Path(__file__).parent), *sys.path])

THREADS = 4
POSES = [BOX.twist(15.0 * turn) for turn in range(THREADS)]
CAMERA = view(size=16)
MASKS = ("rgb", "alpha", "depth", "reveal", "fold", "outside")

# What the objects do on today's machines when two threads use one is a segmentation fault as often as not, so that
# the hammer runs in a process of its own.
HAMMER = """\
import sys
import test_threads
for kind in ("harmonic", "precise"):
    test_threads.hammer(sys.argv[1], kind)
"""


def started(program, *words):
    """A program that finds helpers and this file; it has minutes, which is no measure of speed."""
    environment = os.environ | {"PYTHONPATH": MODULES}
    command = [sys.executable, "-c", program, *words]
    return subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True, timeout=240)


@pytest.fixture(autouse=True)
def fast_switching():
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def at_once(works):
    """Run callables in a thread each, all from the same moment on; the first error is raised."""
    start, errors = threading.Barrier(len(works)), []

    def run(work):
        try:
            start.wait(timeout=60)
            work()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def same(found, expected, device):
    """Equal to the bit on the CPU; a GPU's sums may end in another order."""
    if device == "cpu":
        return np.array_equal(found, expected, equal_nan=True)
    return np.allclose(found, expected, atol=2e-3, equal_nan=True)


def parts(frame):
    return [getattr(frame, name) for name in MASKS]


def hammer(device, kind):
    """Four threads that share a Deformer, and as many that share a map, each with a pose of its own."""
    sys.setswitchinterval(1e-5)
    resolution = None if kind == "precise" else 16
    options = {"coordinates": "mean_value" if kind == "precise" else kind, "resolution": resolution, "device": device}
    exact.GUIDE_RESOLUTION = 24  # a fine guide takes most of the time, and this is a process of its own
    shared = Deformer(shiny_field(device), BOX, **options)
    camera = view(size=6) if kind == "precise" else CAMERA  # closed forms at each sample take long on a CPU
    expected = [parts(shared.pose(pose).render(camera)) for pose in POSES]
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    mapped = [shared.pose(pose).to_canonical(points, points)[0] for pose in POSES]
    shared.pose(POSES[0])

    def frames(turn):
        pose = shared.posed(POSES[turn])
        for _ in range(1 if kind == "precise" else 2):
            found = parts(pose.render(camera))
            assert all(same(*pair, device) for pair in zip(found, expected[turn], strict=True)), f"frame {turn}"
            assert same(pose.to_canonical(points, points)[0], mapped[turn], device), f"points {turn}"
            assert same(shared.render(camera).rgb, expected[0][0], device), "the Deformer's own pose"

    at_once([lambda turn=turn: frames(turn) for turn in range(THREADS)])


def test_threads_that_share_a_deformer_get_the_frames_of_their_own_poses(device):
    done = started(HAMMER, device)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:a cage has gaps")
def test_threads_that_share_a_map_hold_its_lock(kind, device):
    shared = PositionMap(BOX, coordinates=kind, resolution=12, device=device)
    expected = [shared.pose(pose).data.positions.numpy().copy() for pose in POSES]

    def pose(turn):
        for _ in range(3):
            shared.pose(POSES[(turn + 1) % THREADS])  # without the lock: safe, of whichever pose came last
            with shared.lock:
                found = shared.pose(POSES[turn]).data.positions.numpy().copy()  # the next pose is written there
            assert same(found, expected[turn], device)

    at_once([lambda turn=turn: pose(turn) for turn in range(THREADS)])


def test_a_pose_leaves_the_pose_of_its_deformer(device):
    shared = Deformer(shiny_field(device), BOX, resolution=12, device=device)
    own, other = (parts(shared.pose(pose).render(CAMERA)) for pose in (POSES[1], POSES[2]))
    shared.pose(POSES[1])
    handle = shared.posed(POSES[2])
    assert shared.deformed == [POSES[1]] and handle.deformed == [POSES[2]] and handle.deformer is shared
    for _ in range(2):
        assert same(handle.render(CAMERA).rgb, other[0], device) and same(shared.render(CAMERA).rgb, own[0], device)
    solid = bake(shared, resolution=12).node_densities()
    handle.render(CAMERA)
    assert same(bake(shared, resolution=12).node_densities(), solid, device)
    refused(lambda: shared.posed([POSES[0], POSES[0]]), match=MESSAGES["deform.one_cage_per_edit"])
    refused(lambda: shared.posed(BOX.with_vertices(-BOX.vertices)), match="looks inward")
    assert same(shared.render(CAMERA).rgb, own[0], device)


def test_a_pose_of_an_edit_that_removes(device):
    shared = Deformer(shiny_field(device), CageEdit(BOX, remove=True), resolution=12, device=device)
    handle = shared.posed([None])
    assert handle.render(CAMERA).alpha.max() < shared.field.render(CAMERA).alpha.max()


def test_frames_stay_when_the_next_is_rendered(device):
    shared = Deformer(shiny_field(device), BOX, resolution=12, device=device)
    first = shared.posed(POSES[1]).render(CAMERA)
    kept = {name: array.numpy().copy() for name, array in first.arrays.items()}
    shared.posed(POSES[2]).render(CAMERA)
    assert all(np.array_equal(first.arrays[name].numpy(), array) for name, array in kept.items())
    assert all(np.array_equal(getattr(first, name).ravel(), array.ravel()) for name, array in kept.items())


def test_threads_with_a_deformer_each_points_and_fits_go_on_at_once(device):
    field = shiny_field(device)
    own = [Deformer(field, BOX, resolution=12, device=device) for _ in range(2)]
    expected = [parts(each.pose(pose).render(CAMERA)) for each, pose in zip(own, POSES, strict=False)]
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (200, 3))
    moved = deform_points(points, BOX, POSES[1], "green", device=device)
    cameras = turntable((0, 0, 0), 3.0, 20.0, 6, width=16, height=16)
    views = [field.render(camera) for camera in cameras]
    scene = Scene(np.stack([each.rgb for each in views]), np.stack([each.alpha for each in views]), cameras)
    options = {"progress": False, "resolution": 12, "levels": 1, "epochs": 4, "batch_rays": 256, "device": device}
    fitted = fit(scene, **options).node_densities()

    def frames(which):
        for _ in range(4):
            found = parts(own[which].pose(POSES[which]).render(CAMERA))
            assert all(same(*pair, device) for pair in zip(found, expected[which], strict=True))

    def move():
        for _ in range(8):
            assert same(deform_points(points, BOX, POSES[1], "green", device=device), moved, device)

    def learn():
        found = fit(scene, **options).node_densities()
        if device == "cpu":  # the order of sums on a GPU differs from fit to fit
            assert np.array_equal(found, fitted)
        assert np.corrcoef(found.ravel(), fitted.ravel())[0, 1] > 0.99

    at_once([lambda: frames(0), lambda: frames(1), move, learn, learn])


def test_locks_of_devices_and_owners(device):
    found = wp.get_device(device)
    with device_turn(found), device_turn(found):  # again by the same thread
        pass
    assert (owner_lock(found) is owner_lock(found)) == found.is_cuda == (owner_lock(found) is device_turn(found))


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 5, 17, 1000])
def test_parts_cover_all_items_once(threads, count):
    seen, lengths = np.zeros(count, int), []

    def run(begin, end):
        lengths.append(end - begin)
        seen[begin:end] += 1

    with limit_threads(threads):
        run_parts(run, count, threads, 10)
    assert (seen == 1).all() and lengths[0] <= 10
    if threads == 1 and count == 1000:
        assert 10 < max(lengths) <= 80  # quick ones grow


def test_parts_of_slow_items_stay_short():
    lengths = []

    def run(begin, end):
        lengths.append(end - begin)
        time.sleep(0.5 * PART_SECONDS * (end - begin))

    run_parts(run, 12, 1, 4)
    assert lengths[0] == 4 and max(lengths[1:]) <= 2


def test_an_error_in_one_part_ends_the_others(two_threads):
    begun = []

    def run(begin, end):
        begun.append(begin)
        if begin == 0:
            raise ZeroDivisionError
        time.sleep(0.01)

    with pytest.raises(ZeroDivisionError):
        run_parts(run, 1000, 2, 1)
    assert len(begun) < 100


def test_threads_that_start_the_pool_at_once_share_it(two_threads):
    found = []
    tasks = [lambda: found.append(threading.get_ident())] * 8
    for _ in range(20):
        at_once([lambda: run_parallel(tasks, 2)] * THREADS)
    assert len(found) == 20 * THREADS * 8 and len(set(found)) <= 2


INTERRUPTED = """\
import os, signal, sys, threading
import numpy as np
from fields import BOX, shiny_field, view
from warpcage import Deformer
from warpcage.core import limit_threads
signal.signal(signal.SIGINT, signal.default_int_handler)
field = shiny_field("cpu")
step = 1.1e-5 * float(np.linalg.norm(field.bounds[1] - field.bounds[0]))
for threads in (1, 2):
    for scene in (field, Deformer(field, BOX, resolution=8, device="cpu").pose(BOX)):
        with limit_threads(threads):
            scene.render(view(size=4))  # compiled
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
            try:
                sys.exit(str(scene.render(view(size=2000), step=step)))  # takes hours
            except KeyboardInterrupt:
                assert scene.render(view(size=8)).alpha.max() > 0.5
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to send")
def test_an_interrupt_ends_a_long_render():
    """Of a field, and then of a deformer, on one thread and on two."""
    done = started(INTERRUPTED)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize("what", ["view", "pose"])
def test_what_an_interrupt_leaves_half_prepared_is_prepared_again(what, march, device, monkeypatch):
    """In a view of a longer step than that of the one before, and in a pose that follows a view."""
    use_march(march, device, monkeypatch)
    monkeypatch.setattr(lattice_edits, "LOOKS_AHEAD_ON_CPU", True)
    deformer = Deformer(shiny_field(device), BOX, resolution=12, device=device).pose(POSES[1])
    usual, long = None, 8 * deformer.field.step
    expected = {step: parts(deformer.pose(POSES[1]).render(CAMERA, step=step)) for step in (usual, long)}

    def interruptible(whole):
        def interrupted(what, count, inputs, outputs=(), **options):
            if not left[0]:
                for output in outputs:
                    output.zero_() if isinstance(output.dtype, type(LatticeEdit)) else output.fill_(77)
                raise KeyboardInterrupt
            left[0] -= 1
            whole(what, count, inputs, outputs, **options)

        return interrupted

    for interrupts in itertools.count():  # at each of its launches in turn
        if what == "view":
            deformer.pose(POSES[0]).pose(POSES[1]).render(CAMERA)
        else:
            deformer.pose(POSES[0]).render(CAMERA, step=long)
        left = [interrupts]
        with monkeypatch.context() as patch:
            patch.setattr(maps, "launch", interruptible(launch))
            patch.setattr(RecordedLaunch, "__call__", interruptible(RecordedLaunch.__call__))
            try:
                if what == "view":
                    deformer.render(CAMERA, step=long)
                else:
                    deformer.pose(POSES[1])
                break
            except KeyboardInterrupt:
                pass
        if what == "pose":
            assert deformer.deformed is None
            deformer.pose(POSES[1])
        for step in (usual, long):
            found = parts(deformer.render(CAMERA, step=step))
            assert all(same(*pair, device) for pair in zip(found, expected[step], strict=True))
    least = {"view": {"tiles": 4, "rows": 6, "shaded": 12}, "pose": {"tiles": 8, "rows": 11, "shaded": 14}}
    assert interrupts >= least[what][march]


@pytest.fixture
def averaged(tmp_path, monkeypatch):
    """What a kernel gives that is loaded from a kernel cache of its own, as in a process that has just started."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp.config, "use_precompiled_headers", False)  # which take longer to make than a small module

    def averaged():
        average_values.module.unload()
        modules.loaded_places.clear()
        source, joined = wp.array([1.0, 2.0, 3.0, 6.0], dtype=float, device="cpu"), wp.zeros(1, float, device="cpu")
        launch(average_values, 1, [2, 1, source], [joined], device="cpu")
        return joined.numpy()[0]

    assert averaged() == 3.0
    yield averaged
    average_values.module.unload()
    modules.loaded_places.clear()


@pytest.mark.parametrize("ending", [".o", pytest.param(".meta", marks=pytest.mark.nightly)])
def test_damaged_kernel_files_are_compiled_again(ending, averaged, tmp_path, monkeypatch):
    """Or named, where they cannot be replaced."""
    (path,) = tmp_path.glob(f"**/*pictures*{ending}")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda *names: (_ for _ in ()).throw(PermissionError("read-only")))
        message = MESSAGES["core.damaged_kernels"].format(folder=re.escape(str(path.parent)))
        refused(averaged, match=message, error=StateError)
    assert averaged() == 3.0
    assert len(path.read_bytes()) == len(whole) and not list(tmp_path.glob("**/*damaged*"))


def test_threads_that_load_a_module_at_once_get_one(device):
    module = add_gradients.module
    module.unload()
    modules.loaded_places.clear()
    totals, ones = ([wp.full(4, value, dtype=float, device=device) for _ in range(THREADS)] for value in (2.0, 1.0))
    at_once(
        [
            lambda pair=pair: launch(add_gradients, 4, [pair[1]], [pair[0]], device=device)
            for pair in zip(totals, ones, strict=True)
        ]
    )
    assert all((total.numpy() == 3.0).all() for total in totals)
