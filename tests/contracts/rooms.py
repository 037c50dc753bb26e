"""Names of the package's rooms that are not public, wherever they lie in their room."""

import functools
import importlib
import importlib.util
import inspect
import pkgutil


@functools.cache
def named(name, *rooms):
    """A name of one of some rooms: what the room hands on, or else what one of its modules defines."""
    found = [
        importlib.import_module(f"warpcage.{room}") for room in rooms if importlib.util.find_spec(f"warpcage.{room}")
    ]
    for room in found:
        thing = getattr(room, name, None)
        if thing is not None and not inspect.ismodule(thing):
            return thing
    for room in found:
        for module in pkgutil.walk_packages(room.__path__, f"{room.__name__}."):
            if module.name.endswith("__main__"):
                continue
            thing = vars(importlib.import_module(module.name)).get(name)
            if thing is not None and getattr(thing, "__module__", module.name) == module.name:
                return thing
    raise LookupError(f"no room of {', '.join(rooms)} has {name!r}: name it here as it is called now")
