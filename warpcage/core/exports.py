"""Names of a package that are loaded when they are first used (PEP 562, SPEC 1)."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence


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
            found = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
        elif name in rooms:
            found = importlib.import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name)
        setattr(sys.modules[package], name, found)  # the next time Python finds it by itself
        return found

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules, *rooms})

    return load, names, sorted(modules, key=lambda name: (name[0].islower(), name))
