"""Imports of the package: its kernels, its dependencies, old names of modules, and names loaded at their first use."""

from __future__ import annotations

# `typing` and `importlib` take longer to load than all else here: types are plain, imports at their use
import gc
import os.path
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import CodeType, ModuleType
    from typing import Any

#: Modules that are always imported, and the names under which they are installed. Other dependencies are imported where
#: they are used.
NEEDED = {"numpy": "numpy", "warp": "warp-lang", "imageio": "imageio"}

#: Whether this is the package, not a part of it that `warpcage kernels copy` put into another one.
IS_WHOLE = __name__ == "warpcage.package"

#: The release without the old names that still work, with a warning; docs/old_names.md lists them all.
WITHOUT_OLD_NAMES = "0.4"

#: Packages and modules that moved, by the names that they had up to version 0.2; a module stands before its package.
MOVED = {
    "warpcage.batch": "warpcage.studio.jobs",
    "warpcage.cage.motion": "warpcage.cage.pose_file",
    "warpcage.captures": "warpcage.studio.captures",
    "warpcage.cli": "warpcage.studio.cli",
    "warpcage.core.locks": "warpcage.core.threads",
    "warpcage.deform.posed": "warpcage.deform.deformer",
    "warpcage.editor.document": "warpcage.studio.films.document",
    "warpcage.editor": "warpcage.studio.editor",
    "warpcage.edits.words": "warpcage.edits.spec",
    "warpcage.field.clean": "warpcage.select.clean",
    "warpcage.field.objects": "warpcage.select.objects",
    "warpcage.field.planes": "warpcage.select.planes",
    "warpcage.field.selection": "warpcage.select.selection",
    "warpcage.reference": "warpcage.demo",
    "warpcage.films": "warpcage.studio.films",
    "warpcage.view.film": "warpcage.studio.films.video",
    "warpcage.view.film_motion": "warpcage.studio.films.motion",
    "warpcage.view.moves": "warpcage.studio.films.moves",
    "warpcage.view.opacity": "warpcage.view.frame_parts",
}

_PACKAGE = os.path.dirname(os.path.abspath(__file__))

_ROOT = os.path.dirname(_PACKAGE)


def renamed_line(old: str, new: str) -> str:
    """The warning of an old name."""
    return f"{old} is {new} now: the old name goes with warpcage {WITHOUT_OLD_NAMES}"


def require_dependencies() -> None:
    """Raise ImportError where a module of NEEDED is missing."""
    missing = " ".join([NEEDED[module] for module in NEEDED if not _is_installed(module)])
    if missing:
        from .core.names import install_line

        raise ImportError(install_line(missing, _ROOT))


def _is_installed(module: str) -> bool:
    """Whether a top-level module can be imported."""
    for finder in sys.meta_path:
        if hasattr(finder, "find_spec") and finder.find_spec(module, None):
            return True
    return module in sys.modules


def find_kernels(package: str) -> None:
    """Make `kernels` of a checkout importable as a part of the package where nothing else does."""
    # A checkout's warpcage/kernels is a link to ../kernels, which Git on Windows and zip programs do not keep.
    if os.path.isfile(os.path.join(_PACKAGE, "kernels", "__init__.py")):
        return
    name, beside = f"{package}.kernels", os.path.join(_ROOT, "kernels", "__init__.py")
    if not os.path.isfile(beside):
        raise ImportError(f"{name} is missing: {_PACKAGE} is not whole, install warpcage again")
    from importlib import util

    spec = util.spec_from_file_location(name, beside, submodule_search_locations=[os.path.dirname(beside)])
    assert spec and spec.loader
    module = sys.modules[name] = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    vars(sys.modules[package])["kernels"] = module  # as the import system does for modules that it finds itself


class _Moved:
    """Finds and loads a module that moved by its old name: the module itself, with a warning."""

    def __init__(self, spec: ModuleSpec | None = None):
        self.spec = spec  # of the module where it is now

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None, /
    ) -> ModuleSpec | None:
        old = next((old for old in MOVED if name == old or name.startswith(f"{old}.")), None)
        if old is None:
            return None
        import warnings
        from importlib import util

        new = MOVED[old] + name[len(old) :]
        spec = util.find_spec(new)
        if spec is None:
            return None
        warnings.warn(renamed_line(name, new), FutureWarning, stacklevel=2)
        loader: Any = _Moved(spec)
        return util.spec_from_loader(name, loader, is_package=spec.submodule_search_locations is not None)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        from importlib import import_module

        assert self.spec
        return import_module(self.spec.name)

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec  # the import system put the old name there

    def get_code(self, name: str) -> CodeType | None:
        """For `python -m` with an old name."""
        loader: Any = self.spec and self.spec.loader
        return loader.get_code(self.spec and self.spec.name)


def find_moved() -> None:
    """Make modules that moved importable by their old names."""
    sys.meta_path.insert(0, _Moved())  # before the finder of paths, which would load files of a moved package again


def _is_copied(package: str, module: str) -> bool:
    """Whether a copy has a module of one of its packages."""
    base = os.path.join(os.path.dirname(str(sys.modules[package].__file__)), *module.split("."))
    return os.path.isfile(f"{base}.py") or os.path.isfile(os.path.join(base, "__init__.py"))


class PausedCollection:
    """Pauses garbage collection around imports, where it takes a fifth of the time. frozen: what is there by the end is
    never collected, as it stays with a program."""

    def __init__(self, frozen: bool = False):
        self._frozen = frozen

    def __enter__(self) -> None:
        self._collecting = gc.isenabled()
        gc.disable()

    def __exit__(self, *error: object) -> None:
        if self._frozen:
            gc.freeze()
        if self._collecting:
            gc.enable()


def lazy_exports(package: str, homes: dict, packages: list | tuple = (), extra: str = "") -> tuple:
    """`__getattr__`, `__dir__` and `__all__` of a package. homes: names by module, in a list or between
    spaces; packages: modules that are names themselves; extra: a dependency that not all installations have."""
    modules = {}
    for module, names in homes.items():
        if IS_WHOLE or _is_copied(package, module):
            modules |= dict.fromkeys(names.split() if isinstance(names, str) else names, module)

    def load(name: str) -> object:
        if name not in modules and name not in packages and f"{package}.{name}" not in MOVED:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name)
        from importlib import import_module

        try:
            with PausedCollection():
                found = import_module(f".{modules.get(name, name)}", package)
        except ModuleNotFoundError as error:
            if not extra or error.name != extra:
                raise
            from .core.names import extra_line

            raise ImportError(f"{package} needs {extra}: {extra_line(extra)}") from error
        if name in modules:
            found = getattr(found, name)
        setattr(sys.modules[package], name, found)  # the next time Python finds it by itself
        return found

    return load, lambda: sorted({*vars(sys.modules[package]), *modules, *packages}), sorted(modules)
