"""Fixtures: every device present, and the folder of real data where there is one; and how a run uses several cores."""

import importlib
import os
import pathlib

# Workers of pytest-xdist share the cores: each takes its part of them for kernels on the CPU, and so do the processes
# that its tests start. Set before warpcage is imported. Tests of threads ask for them by the fixture `two_threads`.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("WARPCAGE_THREADS", str(max(1, share)))

import pytest  # noqa: E402
import warp as wp  # noqa: E402

wp.config.quiet = True
wp.init()

#: Most workers of a run on a CPU, and beside a GPU, where each of them has a context of its own.
MOST_WORKERS, MOST_WORKERS_CUDA = 8, 4

#: Fixtures of a module that take half a minute: one worker runs all tests that use them.
DEAR = {"lego", "rooms", "maps"}

#: Files whose tests take longest come first, so that no worker is left with one of them at the end.
SLOWEST = (
    "test_examples.py",
    "test_background.py",
    "test_deformed_lego.py",
    "test_cage_generation.py",
    "test_optimize.py",
    "test_kernels.py",
)


def pytest_xdist_auto_num_workers(config):
    return min(os.cpu_count() or 1, MOST_WORKERS_CUDA if wp.is_cuda_available() else MOST_WORKERS)


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist starts its workers
def pytest_sessionstart(session):
    """Compile all kernels for the CPU before workers do, each of which would compile most of them for itself."""
    config = session.config
    of_workers = hasattr(config, "workerinput") or not config.getoption("numprocesses", None)
    if of_workers or config.option.collectonly or config.args_source is not config.ArgsSource.TESTPATHS:
        return
    from warpcage.core.devices import load_modules
    from warpcage.core.kernel_files import kernel_names, kernel_source

    files = [name.replace("/", ".") for name in kernel_names() if "@wp.kernel" in kernel_source(name)]
    load_modules([importlib.import_module(f"warpcage.kernels.{name}") for name in files], "cpu")


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items):
    ranks = {name: rank for rank, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: ranks.get(item.path.name, len(ranks)))
    for item in items:
        for fixture in DEAR.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.xdist_group(fixture))
        if item.path.name == "test_coordinate_accuracy.py" and "bricks" in item.name:
            item.add_marker(pytest.mark.xdist_group("cage of bricks"))


@pytest.fixture(params=["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"])
def device(request):
    return request.param


@pytest.fixture
def two_threads():
    """Kernels on the CPU are cut over two threads, and fits have two shards of gradients, whatever this run's workers
    are given."""
    from warpcage.core.threads import limit_threads

    with limit_threads(2):
        yield


@pytest.fixture
def real_data():
    """Folder that holds lego_800 and the like; the test is skipped without it."""
    folder = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data"))
    if not (folder / "lego_800" / "transforms_train.json").is_file():
        pytest.skip(f"no data in {folder} (set WARPCAGE_DATA)")
    return folder
