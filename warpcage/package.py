"""The package itself: kernels and dependencies that it finds, and names that are loaded when they are first used."""

from __future__ import annotations

import importlib.util
import os.path
import sys
from importlib import import_module

TYPE_CHECKING = False  # type checkers take it for true; `typing` takes as long to load as all else here
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

#: Modules that the package's own modules import at once, and the names under which they are installed. The other
#: dependencies are imported where they are used.
NEEDED = {"numpy": "numpy", "warp": "warp-lang", "imageio": "imageio"}

_PACKAGE = os.path.dirname(os.path.abspath(__file__))

_ROOT = os.path.dirname(_PACKAGE)


def require_dependencies() -> None:
    """Refuse to begin where a module is missing that the package imports."""
    missing = [name for module, name in NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        import shlex

        names = " ".join(missing)
        # a checkout installs all its dependencies, those that are imported later too
        what = f"-e {shlex.quote(_ROOT)}" if os.path.isfile(os.path.join(_ROOT, "setup.py")) else names
        raise ImportError(f"warpcage needs {names}: pip install {what}")


def find_kernels(package: str) -> None:
    """Make `kernels` of a checkout importable as a part of the package where nothing else does."""
    # A checkout's warpcage/kernels is a link to ../kernels, which Git on Windows and zip programs do not keep.
    name = f"{package}.kernels"
    found = importlib.util.find_spec(name)
    if found is not None and found.origin is not None:
        return
    folder = os.path.join(_ROOT, "kernels")
    path = os.path.join(folder, "__init__.py")
    spec = importlib.util.spec_from_file_location(name, path, submodule_search_locations=[folder])
    if not os.path.isfile(path) or spec is None or spec.loader is None:
        raise ImportError(f"{name} is missing: {_PACKAGE} is not whole, install warpcage again")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    vars(sys.modules[package])["kernels"] = module  # as the import system does for modules that it finds itself


def lazy_exports(
    package: str, homes: Mapping[str, str | Sequence[str]], rooms: Iterable[str] = ()
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package. homes: names by module, as a list or as words;
    rooms: its modules that are names themselves."""
    modules = {
        name: module for module, names in homes.items() for name in (names.split() if isinstance(names, str) else names)
    }

    def load(name: str) -> object:
        if name in modules:
            found = getattr(import_module(f"{package}.{modules[name]}"), name)
        elif name in rooms:
            found = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name)
        setattr(sys.modules[package], name, found)  # the next time Python finds it by itself
        return found

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules, *rooms})

    return load, names, sorted(modules, key=lambda name: (name[0].islower(), name))
