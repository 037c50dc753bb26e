"""One module a scene format: MARK (what it looks for), is_scene(folder) and read(folder, *, split, downscale,
background, masks) -> Scene. The order is that of detection: a folder that fits several is the first."""

from . import blender, colmap, dtu, nsvf, transforms

READERS = {"blender": blender, "nsvf": nsvf, "dtu": dtu, "transforms": transforms, "colmap": colmap}
