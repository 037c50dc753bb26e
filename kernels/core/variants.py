"""How kernels are declared: variants as Warp modules of their own, and C++ that stands in files beside them."""

import functools
import inspect
import threading
from pathlib import Path
from typing import Any

import warp as wp

lock = threading.RLock()  #: while kernels are declared or loaded: Warp keeps modules by their names for all threads


def variant_module(file: str, variant: str, **options: Any) -> wp.Module:
    """The Warp module of a variant. file: `__name__` of the kernel file; options: beside those of all kernel files."""
    # one each, as a second kernel of a name replaces the first; "unique" would hash all callees at once: 13 ms
    module = wp.get_module(f"{file}.{variant}")
    wp.set_module_options({"enable_backward": False, "default_grid_stride": False, **options}, module=module)
    return module


def declared_once(make: Any) -> Any:
    """Decorates what declares a kernel: the same arguments get the same kernel, whichever thread asks."""
    made, signature = functools.cache(make), inspect.signature(make)

    @functools.cache  # so that who asks again does not wait for a compiler
    @functools.wraps(make)
    def declared(*values: Any, **named: Any) -> Any:
        bound = signature.bind(*values, **named)
        bound.apply_defaults()
        with lock:
            return made(*bound.args, **bound.kwargs)

    return declared


def by_device(cuda: str, cpu: str) -> str:
    """The body of a C++ function that returns one expression on CUDA and another on a CPU."""
    return f"#if defined(__CUDA_ARCH__)\n    return {cuda};\n#else\n    return {cpu};\n#endif\n"


def native_constants(**values: int | float) -> str:
    """Constants of Python by their names in C++."""
    return "".join(
        f"constexpr {type(value).__name__} {name} = {value}{'f' if isinstance(value, float) else ''};\n"
        for name, value in values.items()
    )


def native_source(file: str, name: str) -> str:
    """The text of a C++ file beside a Python file, with the files that it includes in their places."""
    path = Path(file).parent / name
    text = ""
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        text += native_source(str(path), line.split('"')[1]) if line.startswith("#include ") else line
    return text
