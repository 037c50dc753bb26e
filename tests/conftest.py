"""Fixtures: every device present, and the folder of real data where there is one; and how a run uses several cores."""

import concurrent.futures
import contextlib
import gc
import importlib
import json
import os
import pathlib
import shutil
import signal
import tempfile

# What is imported and collected stays for the whole run: looking through it for garbage, again and again, takes a
# quarter of the time until the first test.
gc.disable()

# A shell that starts a run in the background lets it ignore interrupts, and tests send some.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Workers of pytest-xdist share the cores: each takes its part of them for kernels on the CPU and for linear algebra,
# whose threads would wait for each other at full speed, and so do the processes that its tests start. Set before
# warpcage and NumPy are imported. Tests of threads ask for them by the fixture `two_threads`.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    for variable in ("WARPCAGE_THREADS", "OMP_NUM_THREADS"):  # which OpenBLAS reads, too
        os.environ.setdefault(variable, str(max(1, share)))

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # JAX would take most of a GPU for each worker

import filelock
import pytest
import warp as wp

wp.init()

pytest_plugins = ["tiers", "needs", "costs"]

#: Most workers of a run on a CPU, and beside a GPU, where each of them has a context of its own; and how many there are
#: more than cores, as some tests wait: for a browser, or for another process.
MAX_WORKERS, MAX_WORKERS_CUDA, MORE_THAN_CORES = 8, 4, 2

#: Files whose tests take longest come first, so that no worker is left with one of them at the end.
LONGEST = (
    "test_batch_kills.py",
    "test_editor_page.py",
    "test_editor_looks.py",
    "test_batch_run.py",
    "test_editor_parts.py",
    "test_objects_page.py",
    "test_capture.py",
    "test_examples.py",
)


def pytest_xdist_auto_num_workers(config):
    most = MAX_WORKERS_CUDA if wp.is_cuda_available() else MAX_WORKERS
    return min((os.cpu_count() or 1) + MORE_THAN_CORES, most)


def compile_all(lock):
    """Compile all kernels and variants for the CPU before workers do, each of which would compile most of them."""
    from warpcage.core import kernel_names, kernel_source, load_modules

    try:
        names = [name.replace("/", ".") for name in kernel_names() if "@wp.kernel" in kernel_source(name)]
        files = [importlib.import_module(f"warpcage.kernels.{name}") for name in names]
        own = [file for file in files if wp.get_module(file.__name__).kernels]
        load_modules([*own, *(kernel for file in files for kernel in getattr(file, "variants", list)())], "cpu")
    finally:
        lock.release()
        gc.enable()  # this process collects no tests


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist starts its workers
def pytest_sessionstart(session):
    """Kernels are compiled while workers collect, which wait for them then."""
    config = session.config
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        return
    if not (config.option.collectonly or config.option.markexpr) and config.args_source is config.ArgsSource.TESTPATHS:
        config.compiling = filelock.FileLock(f"{tempfile.mkdtemp()}/compiling.lock", thread_local=False)
        config.compiling.acquire()
        config.compiled = concurrent.futures.ThreadPoolExecutor(1).submit(compile_all, config.compiling)
    else:
        gc.enable()


def pytest_sessionfinish(session):
    if hasattr(session.config, "compiled"):
        session.config.compiled.result()  # raises what ended it
        shutil.rmtree(pathlib.Path(session.config.compiling.lock_file).parent)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node):
    if hasattr(node.config, "compiling"):
        node.workerinput["compiling"] = node.config.compiling.lock_file


def one_after_another(config, what):
    """Of workers, one at a time does this; other processes just do it."""
    if not hasattr(config, "workerinput"):
        return contextlib.nullcontext()
    return filelock.FileLock(pathlib.Path(config.option.basetemp).parent / f"{what}.lock")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """One worker at a time imports a file of tests, as the first one compiles it for all: that takes longer than the
    rest of collecting. The others follow it through the files."""
    if not isinstance(collector, pytest.Module):
        return (yield)
    with one_after_another(collector.config, collector.path.stem):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config, items):
    with one_after_another(config, "items"):  # Hypothesis looks for numbers in all sources, and keeps them for all
        yield
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


def pytest_collection_finish(session):
    gc.freeze()
    gc.enable()
    if "compiling" in getattr(session.config, "workerinput", {}):
        with filelock.FileLock(session.config.workerinput["compiling"]):
            pass  # kernels are compiled


@pytest.fixture(params=["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"])
def device(request):
    return request.param


@pytest.fixture
def two_threads():
    """Kernels on the CPU are cut over two threads, and fits have two shards of gradients, whatever this run's workers
    are given."""
    from warpcage.core import limit_threads

    with limit_threads(2):
        yield


@pytest.fixture(scope="session")
def browser():
    """A browser for windows at the editor, see tests/support/editor_browser.py."""
    from page_probe import chromium

    with chromium(1024, 768, ratio=0.5) as driver:  # pictures of few pixels are cheap
        yield driver


@pytest.fixture(scope="session")
def page():
    """The modules of the editor's page in a browser of their own. At the end its console holds nothing severe."""
    from page_probe import Modules, chromium, page_files

    with page_files() as address, chromium() as driver:
        driver.get(address)
        yield Modules(driver)
        assert [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of what commands take, see tests/support/runs.py."""
    from runs import write_files

    return write_files(tmp_path_factory.mktemp("files"))


@pytest.fixture(scope="module")
def bricks():
    """Pictures that are written in the formats of scenes."""
    from scene_writers import brick_pictures

    return brick_pictures(10)


@pytest.fixture(scope="module")
def centered():
    """The same with one focal length and a principal point in the middle."""
    from scene_writers import brick_pictures

    return brick_pictures(10, centered=True)


@pytest.fixture
def real_data():
    """Folder that holds lego_800 and the like; the test is skipped without it."""
    folder = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data"))
    if not (folder / "lego_800" / "transforms_train.json").is_file():
        pytest.skip(f"no data in {folder} (set WARPCAGE_DATA)")
    return folder


@pytest.fixture(scope="session")
def thin_lego(tmp_path_factory):
    """NeRF-synthetic Lego with every third of its training pictures: reading all takes longer than a small fit."""
    source = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data")) / "lego_800"
    if not (source / "transforms_train.json").is_file():
        pytest.skip(f"no data in {source} (set WARPCAGE_DATA)")
    folder = tmp_path_factory.mktemp("lego")
    content = json.loads((source / "transforms_train.json").read_text(encoding="utf-8"))
    content["frames"] = content["frames"][::3]
    (folder / "transforms_train.json").write_text(json.dumps(content), encoding="utf-8")
    for frame in content["frames"]:
        picture = folder / f"{frame['file_path']}.png"
        picture.parent.mkdir(exist_ok=True)
        shutil.copy(source / f"{frame['file_path']}.png", picture)
    return folder


@pytest.fixture(scope="session")
def lego(thin_lego):
    """A fit of those pictures, at a sixteenth of their size, in a tenth of the steps."""
    import warpcage

    return warpcage.fit(warpcage.load_scene(thin_lego, downscale=16), progress=False, epochs=4)
