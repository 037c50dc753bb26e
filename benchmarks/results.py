"""Write results of a benchmark to a JSON file, with the machine and the versions that they were measured on."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import pathlib
import platform
import shlex
import sys

import numpy as np
import warp as wp

import warpcage


def machine(device) -> dict:
    """What the figures were measured on."""
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
    for package in ("scikit-image", "trimesh"):
        if importlib.util.find_spec(package.replace("scikit-image", "skimage")):  # a GPU machine may lack them
            facts[package] = importlib.metadata.version(package)
    return facts


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def command_line() -> str:
    """How this script was called from the project's folder, without the folders of this machine."""
    words = [f"python benchmarks/{pathlib.Path(sys.argv[0]).name}"]
    given = [os.path.basename(word) if os.path.isabs(word) else word for word in sys.argv[1:]]
    return " ".join(words + [shlex.quote(word) for word in given])


def write_results(path, device, **content) -> None:
    """Write {command, machine, **content} to a JSON file; its folder is made, floats keep five digits."""
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_rounded({"command": command_line(), "machine": machine(device), **content}), indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def _rounded(value):
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

    from warpcage.view.pictures import to_uint8

    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, to_uint8(image), quality=quality)
