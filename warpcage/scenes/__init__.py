"""One module a scene format: MARK (what it looks for), is_scene(folder) and read(folder, ...)."""

from . import blender

READERS = {"blender": blender}
