"""Import this package from whatever is there: a wheel, an editable install, or the root of a checkout.

`warpcage/__init__.py` calls both functions before it imports anything else, so this file needs the standard library
alone.
"""

from __future__ import annotations

import importlib.util
import pathlib
import shlex
import sys

#: Modules that are imported with the package, and the names under which they are installed. The other dependencies are
#: imported where they are used.
NEEDED = {"numpy": "numpy", "warp": "warp-lang", "imageio": "imageio"}

_PACKAGE = pathlib.Path(__file__).parents[1]


def require_dependencies() -> None:
    """Refuse to begin where a module is missing that the package imports.

    Raises:
        ImportError: One line that names what is missing and the command that installs it.
    """
    missing = [name for module, name in NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        names = " ".join(missing)
        # a checkout installs all its dependencies, those that are imported later too
        what = f"-e {shlex.quote(str(_PACKAGE.parent))}" if (_PACKAGE.parent / "setup.py").is_file() else names
        raise ImportError(f"warpcage needs {names}: pip install {what}")


def find_kernels(package: str) -> None:
    """Make `kernels` of a checkout importable as a part of the package where nothing else does.

    In a checkout warpcage/kernels is a symbolic link to ../kernels. Git on Windows and programs that pack zip files do
    not keep it. An installed package holds the kernels themselves.

    Args:
        package: Name of the package that is being imported.

    Raises:
        ImportError: One line that says what to do where there are no kernels at all.
    """
    name = f"{package}.kernels"
    found = importlib.util.find_spec(name)
    if found is not None and found.origin is not None:
        return
    folder = _PACKAGE.parent / "kernels"
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if not (folder / "__init__.py").is_file() or spec is None or spec.loader is None:
        raise ImportError(f"{name} is missing: {_PACKAGE} is not whole, install warpcage again")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    vars(sys.modules[package])["kernels"] = module  # as the import system does for modules that it finds itself
