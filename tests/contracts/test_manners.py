"""How the program behaves among others: it starts at once, and ends in one line whatever happens around it."""

import io
import os
import pathlib
import pickle
import re
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp
from messages import MESSAGES

import warpcage
from warpcage.core import atomic_path
from warpcage.studio.cli import main
from warpcage.view import read_image


def child(code, *words, options=(), **more):
    """Python with some code. Most of these do not load Warp: they take a tenth of a second."""
    command = [sys.executable, *options, "-c", textwrap.dedent(code), *map(str, words)]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120, **more)


@pytest.fixture
def command(monkeypatch):
    """Makes `warpcage info` do something else."""
    return lambda action: monkeypatch.setattr("warpcage.studio.cli.info.run_info", lambda arguments: action())


def fails(error):
    def action():
        raise error

    return action


# The names of the package


def test_names_and_help_load_neither_numpy_nor_warp():
    done = child(
        """
        import contextlib, io, sys
        import warpcage, warpcage.studio.cli
        from warpcage.studio.cli.program import COMMANDS
        assert set(warpcage.__all__) < set(dir(warpcage)) and warpcage.__version__
        for words in [[], *([name] for name in COMMANDS)]:
            with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
                warpcage.studio.cli.main([*words, "--help"])
            assert "usage: warpcage" in text.getvalue()
        heavy = {"warp", "numpy", "imageio", "av", "PIL", "trimesh", "scipy", "skimage", "tqdm"} & set(sys.modules)
        assert not heavy, heavy
        assert not [name for name in sys.modules if name.startswith("warpcage.kernels")]
        """
    )
    assert done.returncode == 0, done.stderr


def test_the_library_works_without_the_studio(tmp_path):
    """Pictures, a field, a cage, a pose and a frame, and nothing of the programs is loaded."""
    done = child(
        """
        import sys
        import warpcage
        from warpcage.demo import write_brick_scene
        write_brick_scene(sys.argv[1], train_views=6, test_views=1, size=24, samples=1, device="cpu")
        scene = warpcage.load_scene(sys.argv[1])
        small = {"resolution": 24, "levels": 1, "epochs": 1, "batch_rays": 256}
        field = warpcage.fit(scene, device="cpu", progress=False, **small)
        cage = warpcage.Cage.box(field.bounds, segments=2)
        deformer = warpcage.Deformer(field, cage, coordinates="mean_value", resolution=12)
        assert deformer.pose(cage.bend(20)).render(scene.cameras[0]).rgb.shape == (24, 24, 3)
        loaded = [name for name in sys.modules if name.startswith("warpcage.studio")]
        assert not loaded, loaded
        """,
        tmp_path / "scene",
    )
    assert done.returncode == 0, done.stderr


def test_names_behave_as_if_they_were_imported():
    everything = {}
    exec("from warpcage import *", everything)
    assert set(warpcage.__all__) == set(everything) - {"__builtins__"}
    for name in warpcage.__all__:
        item = getattr(warpcage, name)
        assert item is everything[name] is pickle.loads(pickle.dumps(item)) is vars(warpcage)[name]
    packages = [path.parent.name for path in pathlib.Path(warpcage.__file__).parent.glob("*/__init__.py")]
    assert sorted(packages) == sorted(warpcage._PACKAGES)  # noqa: SLF001  (no public name lists them)
    assert all(getattr(warpcage, package).__name__ == f"warpcage.{package}" for package in packages)
    with pytest.raises(AttributeError, match=MESSAGES["core.no_attribute"]):
        warpcage.Deformr  # noqa: B018


# Interrupts and signals


@pytest.mark.parametrize("module", ["warpcage.studio.cli.arguments", "numpy", "warp"])
def test_an_interrupt_while_the_program_starts_leaves_no_traceback(module):
    done = child(
        """
        import os, signal, sys

        def interrupt(event, arguments):
            if event == "import" and arguments[0] == sys.argv[1]:
                os.kill(os.getpid(), signal.SIGINT)

        signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
        sys.addaudithook(interrupt)
        from warpcage.studio.cli import main
        sys.exit(main(["info"]))
        """,
        module,
    )
    assert (done.returncode, done.stderr) == (130, "warpcage: interrupted\n")


@pytest.mark.parametrize("name, status", [("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_that_ends_the_program_leaves_no_half_written_file(tmp_path, command, capsys, name, status):
    number = getattr(signal, name)

    def half_a_film():
        with atomic_path(tmp_path / "out.mp4") as temporary:
            temporary.write_bytes(b"half")
            os.kill(os.getpid(), number)
            time.sleep(60)

    command(half_a_film)
    before = signal.signal(number, lambda *_: pytest.fail("the command left the signal to others"))
    try:
        guard = signal.getsignal(number)
        assert main(["info"]) == status
        assert signal.getsignal(number) is guard
        signal.signal(number, signal.SIG_IGN)  # as nohup does: then it means nothing
        command(lambda: os.kill(os.getpid(), number))
        assert main(["info"]) == 0
    finally:
        signal.signal(number, before)
    assert capsys.readouterr().err == "warpcage: terminated\n" and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name, status", [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_in_a_destructor_is_not_lost(command, capsys, name, status):
    """Python reports what is raised there, and goes on."""

    class Freed:
        def __del__(self):
            os.kill(os.getpid(), getattr(signal, name))
            sum(range(10))  # the handler runs here

    def frees():
        item = Freed()
        del item
        time.sleep(9)

    command(frees)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["info"]) == status
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == f"warpcage: {'interrupted' if status == 130 else 'terminated'}\n"


def test_a_command_runs_in_any_thread(command):
    """Python handles signals in the main thread alone."""
    command(lambda: 1)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(main, ["info"]).result() == 1


# Errors


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "not enough memory"),
        (MemoryError("Unable to allocate 9 TiB"), "not enough memory: Unable to allocate 9 TiB"),
        (OverflowError("int too big to convert"), "a number is too large: int too big to convert"),
        (ModuleNotFoundError("No module named 'av'"), "No module named 'av': install warpcage again"),
        (RuntimeError("Failed to allocate 8 bytes\n on device 'cpu'"), "Failed to allocate 8 bytes on device 'cpu'"),
        (Exception("Failed to load CPU module 'm'\n  (cut)"), "Failed to load CPU module 'm' (cut)"),
    ],
)
def test_what_goes_wrong_takes_one_line(command, capsys, error, said):
    command(fails(error))
    assert main(["info"]) == 2
    text = capsys.readouterr().err
    assert text.startswith(f"warpcage: error: {said}") and text.count("\n") == 1


def test_mistakes_of_the_program_keep_their_traceback(command):
    command(fails(KeyError("forgotten")))
    with pytest.raises(KeyError):
        main(["info"])


# Standard output


def test_names_that_the_output_cannot_spell_are_escaped(command, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stream)
    command(lambda: print("wrote für.png"))
    assert main(["info"]) == 0
    assert stream.buffer.getvalue() == b"wrote f\\xfcr.png\n" and sys.stdout is stream


def test_a_reader_that_leaves_does_not_end_the_work(command, monkeypatch):
    done = []

    def work():
        for _ in range(3):
            print("line", flush=True)
            print("more", file=sys.stderr, flush=True)
        done.append(True)

    command(work)
    for name in ("stdout", "stderr"):
        reading, writing = os.pipe()
        os.close(reading)
        monkeypatch.setattr(f"sys.{name}", os.fdopen(writing, "w"))
    with sys.stdout, sys.stderr:
        assert main(["info"]) == 0
    assert done == [True]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is always full")
def test_an_output_that_is_lost_on_a_full_disk_is_an_error(command, monkeypatch, capsys):
    command(lambda: print("the report"))
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert main(["info"]) == 2
    assert re.fullmatch(MESSAGES["core.no_space"] + "\n", capsys.readouterr().err)


def test_closed_descriptors_lose_messages_and_nothing_else(tmp_path):
    """The next file that is opened would get the number of the closed one, and what Warp prints would end in it."""
    code = """
        import os, sys, types
        import warpcage.studio.cli

        def run_info(arguments):
            with open(sys.argv[1], "w") as file:
                print("a message")
                print("a warning", file=sys.stderr)
                os.write(1, b"from a library")
                file.write("results")

        sys.modules["warpcage.studio.cli.info"] = types.SimpleNamespace(run_info=run_info)
        sys.exit(warpcage.studio.cli.main(["info"]))
    """
    out = tmp_path / "out.txt"
    done = child(code, out, preexec_fn=lambda: [os.close(number) for number in range(3)])
    assert done.returncode == 0 and out.read_text() == "results"


# Poor places


def test_a_command_works_in_a_poor_place(tmp_path):
    """Warnings as errors, no assertions, few descriptors, and a home that cannot be written to, which is said."""
    density = np.full((8, 8, 8), 20.0, np.float32)
    warpcage.VoxelField.from_dense(density, np.zeros((8, 8, 8, 9, 3)), [[-1] * 3, [1] * 3]).save(tmp_path / "ball.npz")
    cage = warpcage.Cage.box((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2))
    cage.save(tmp_path / "cage.obj")
    cage.twist(20).save(tmp_path / "posed.obj")
    code = """
        import os, resource, sys
        resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
        from warpcage.studio.cli import main
        words = "render ball.npz --cage cage.obj --posed posed.obj --size 16 --coordinates mean_value --resolution 12"
        words = [*words.split(), "--device", "cpu", "--out", "frame.png"]
        refused = main(words), os.path.exists("frame.png")
        import warp
        warp.config.kernel_cache_dir, os.environ["WARP_CACHE_PATH"] = None, sys.argv[1]  # as at its start
        sys.exit(main(words) if refused == (2, False) else 9)
    """
    strict = ["-W", "error", "-W", "ignore:Support for Python:FutureWarning", "-O"]  # Warp on the oldest Python
    poor = {name: value for name, value in os.environ.items() if name not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    cache = pathlib.Path(wp.config.kernel_cache_dir).parent  # of this process: nothing is compiled anew
    done = child(code, cache, options=strict, cwd=tmp_path, env=poor | {"HOME": os.devnull})
    said = [line for line in done.stderr.splitlines() if line.startswith("warpcage: error: ")]
    assert done.returncode == 0 and len(said) == 1 and "WARP_CACHE_PATH" in said[0], done.stderr
    assert read_image(tmp_path / "frame.png").shape[:2] == (16, 16)
