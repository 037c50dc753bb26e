"""Which modules of kernels have compiled for CUDA: `python tests/support/compiled.py` compiles those that changed and
keeps the record, tests/library/core/compiled.json, so that tests compile what is not in it."""

import importlib
import json
import pathlib
import tempfile

import warp as wp

from warpcage.core import kernel_names, kernel_source

RECORD = pathlib.Path(__file__).resolve().parents[1] / "library" / "core" / "compiled.json"


def warp_modules(name):
    """The Warp modules of a file of kernels: that of its own kernels, and those of its variants."""
    file = importlib.import_module(f"warpcage.kernels.{name.replace('/', '.')}")
    own = wp.get_module(file.__name__)
    return [*([own] if own.kernels else []), *(kernel.module for kernel in getattr(file, "variants", list)())]


def left(modules):
    """Those that are not in the record as they are, or all of them for another version of Warp."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    known = set(record["modules"]) if record["warp"] == wp.__version__ else set()
    return [module for module in modules if module.get_module_identifier() not in known]


def write_record():
    files = [name for name in kernel_names() if "@wp.kernel" in kernel_source(name)]
    modules = [module for name in files for module in warp_modules(name)]
    names = sorted(module.get_module_identifier() for module in modules)
    with tempfile.TemporaryDirectory() as folder:
        for module in left(modules):
            print("compiles", module.name)
            wp.compile_aot_module(module, arch=90, module_dir=folder)
    RECORD.write_text(json.dumps({"warp": wp.__version__, "arch": 90, "modules": names}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    write_record()
