"""What the benchmarks share: their commands and options, timing, memory, results with the machine they are of.

Only the standard library is imported at the top: some commands also run where there is nothing else.
"""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import json
import os
import pathlib
import platform
import shlex
import statistics
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent

sys.path.insert(0, str(HERE.parent / "tests" / "support"))  # ground truth and makers of files, which tests share

#: What starts a command of the benchmarks in a process of its own.
BENCHMARKS = [sys.executable, str(HERE)]

KINDS = ("mean_value", "harmonic", "green")

#: Megabytes of a page of memory, and by how many a long run may grow.
MEMORY_PAGE, GROWTH = os.sysconf("SC_PAGE_SIZE") / 2**20, 16.0


# Commands


class UsageError(Exception):
    """Options that do not go together."""


def option(*names: str, **more) -> tuple:
    """An option of a command, as argparse's add_argument takes it."""
    return names, more


def command(*options: tuple):
    """Mark a function of the parsed options as a command; its docstring is the help, its name the command's."""

    def marked(function):
        function.options = options
        return function

    return marked


DEVICE = option("--device", help="Warp device (default: CUDA where there is one)")
JSON = option("--json", help="file for the results")
QUICK = option("--quick", action="store_true", help="small, on the CPU")
FIELD = option("--field", required=True, help="field file")
CAGE = option("--cage", required=True, help="cage file, at rest")
FIT_OPTIONS = option("--option", nargs="*", default=[], help="FitOptions as name=value")


def fit_options(pairs: list[str]) -> dict:
    """The values of FIT_OPTIONS."""
    return {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in pairs)}


def quiet_device(name: str | None):
    """The Warp device of a name, without Warp's reports."""
    from warpcage.core import resolve_device

    return resolve_device(name)


def pickle_by_value(module: str) -> None:
    """Let Ray send a module's classes as they are: its workers cannot import the benchmarks."""
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[module])


# Time


def seconds_of(action, device) -> float:
    """Wall-clock seconds of action(), with the device idle before and after."""
    import warp as wp

    wp.synchronize_device(device)
    begin = time.perf_counter()
    action()
    wp.synchronize_device(device)
    return time.perf_counter() - begin


def seconds_by_turns(actions, device, *, runs: int = 20, warm: int = 2) -> list[list[float]]:
    """Seconds of each run of several actions by turns, so that other work on the machine affects all of them."""
    times: list[list[float]] = [[] for _ in actions]
    for run in range(warm + runs):
        for action, taken in zip(actions, times, strict=True):
            seconds = seconds_of(action, device)
            if run >= warm:
                taken.append(seconds)
    return times


def median_seconds(action, device, *, runs: int = 20, warm: int = 2) -> float:
    """Median seconds of warm runs."""
    return statistics.median(seconds_by_turns([action], device, runs=runs, warm=warm)[0])


def launch_times(action) -> list[tuple[str, float]]:
    """Names and milliseconds of what action() launches on CUDA, in order."""
    import warp as wp

    wp.timing_begin(cuda_filter=wp.TIMING_ALL)
    action()
    return [(result.name, result.elapsed) for result in wp.timing_end()]


# Memory


def resident(pid: int | str = "self") -> float:
    """Megabytes that a process holds in memory; not a number where it is gone."""
    try:
        with open(f"/proc/{pid}/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * MEMORY_PAGE
    except FileNotFoundError:
        return float("nan")


# Results


def machine(device) -> dict:
    """What the figures were measured on."""
    import numpy as np
    import warp as wp

    import warpcage

    device = wp.get_device(device)
    facts = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "warp": wp.__version__,
        "warpcage": warpcage.__version__,
        "device": device.name,
    }
    if device.is_cuda:
        toolkit, driver = wp.get_cuda_toolkit_version(), wp.get_cuda_driver_version()
        facts |= {
            "cuda_toolkit": ".".join(map(str, toolkit)),
            "cuda_driver": ".".join(map(str, driver)),
            "memory_gigabytes": round(device.total_memory / 2**30),
        }
    for package, module in (("scikit-image", "skimage"), ("trimesh", "trimesh"), ("pymeshlab", "pymeshlab")):
        if importlib.util.find_spec(module):  # a GPU machine may lack them
            facts[package] = importlib.metadata.version(package)
    return facts


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def command_line() -> str:
    """How this was called from the project's folder, without the folders of this machine."""
    script = pathlib.Path(sys.argv[0])
    name = "" if script.suffix != ".py" or script.name == "__main__.py" else f"/{script.name}"
    given = [os.path.basename(word) if os.path.isabs(word) else word for word in sys.argv[1:]]
    return " ".join([f"python benchmarks{name}", *(shlex.quote(word) for word in given)])


def write_results(path, device, **content) -> None:
    """Write {command, machine, **content} to a JSON file, if there is one to write; floats keep five digits."""
    if path is None:
        return
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_rounded({"command": command_line(), "machine": machine(device), **content}), indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def _rounded(value):
    import numpy as np

    if isinstance(value, dict):
        return {str(name): _rounded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.5g}")
    return int(value) if isinstance(value, np.integer) else value


def write_jpeg(path, image, quality: int = 88) -> None:
    """Write an (h, w, 3) picture in [0, 1]."""
    import imageio.v3 as iio

    from warpcage.view import to_uint8

    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, to_uint8(image), quality=quality)


# Objects that are measured


def ball_field(device):
    """A field of a ball of radius 0.8, colored by place."""
    import numpy as np

    import warpcage

    n = 24
    nodes = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), axis=-1)
    sh = np.zeros((n, n, n, 9, 3), np.float32)
    sh[..., 0, :] = nodes
    density = np.where(np.linalg.norm(nodes, axis=-1) < 0.8, 20.0, 0.0).astype(np.float32)
    return warpcage.VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device=device)


def turntable_view(field, width: int, height: int, *, distance: float = 4.03):
    """The view of a field that its frames are timed in; wider pictures show more beside it."""
    import dataclasses

    import warpcage

    camera = warpcage.turntable(
        field.center, distance, 30, 1, fov_degrees=39.6, width=height, height=height, start_degrees=30
    )[0]
    return dataclasses.replace(camera, width=width, cx=camera.cx + 0.5 * (width - height))


def write_twists(folder: pathlib.Path, name: str, cage, count: int) -> None:
    """A cage as `name`.obj in a folder, and many twists of it as `name`.npy."""
    import numpy as np

    cage.save(folder / f"{name}.obj")
    turns = 60.0 * np.sin(np.arange(count))
    np.save(folder / f"{name}.npy", np.stack([cage.twist(float(turn)).vertices for turn in turns]))
