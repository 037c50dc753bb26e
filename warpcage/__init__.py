"""Cage-based deformation of radiance fields on NVIDIA Warp.

images + cameras -> Scene -> VoxelField -> surface mesh -> Cage -> coordinates on a lattice -> deformed frames,
after Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022).

Each name is loaded when it is first used (PEP 562, SPEC 1), so that `import warpcage` takes no time. `__init__.pyi`
tells type checkers what the names are.
"""

from __future__ import annotations

import importlib

from .core.checkout import find_kernels, require_dependencies

require_dependencies()
find_kernels(__name__)

__version__ = "0.1.0"

#: Public names, and the modules that they come from.
_HOMES = {
    "Cage": "cage.cage",
    "CageEdit": "edits.edits",
    "CageReport": "cage.check",
    "Camera": "view.camera",
    "CameraFile": "view.camera",
    "CameraKey": "view.camera",
    "CaptureReport": "captures.report",
    "Deformer": "deform.deformer",
    "FieldOptimizer": "fitting.optimizer",
    "FitOptions": "fitting.options",
    "Frame": "view.frame",
    "NodeSelection": "field.selection",
    "PoseFile": "cage.pose_file",
    "PositionMap": "lattice.position_map",
    "RandomPoses": "cage.random_poses",
    "RunReport": "batch.run",
    "Scene": "scene.scene",
    "SplatDeformer": "deform.deformer",
    "SplatField": "splats.splat_field",
    "SplatRates": "splats.fit",
    "VoxelField": "field.voxel_field",
    "bake": "deform.bake",
    "camera_at": "view.camera_path",
    "capture": "captures.capture",
    "deform_points": "coordinates.coordinates",
    "edit": "editor.edit",
    "evaluate": "fitting.evaluation",
    "fill_unseen": "deform.fill",
    "fit": "fitting.fit",
    "fit_splats": "splats.fit",
    "green_coordinates": "coordinates.coordinates",
    "harmonic_coordinates": "coordinates.coordinates",
    "load_scene": "scene.load",
    "mean_psnr": "fitting.evaluation",
    "mean_value_coordinates": "coordinates.coordinates",
    "psnr": "fitting.evaluation",
    "run_jobs": "batch.run",
    "select_nodes": "field.selection",
    "select_object": "field.objects",
    "turntable": "view.camera",
}

_ROOMS = (
    "batch",
    "cage",
    "captures",
    "cli",
    "coordinates",
    "core",
    "deform",
    "editor",
    "edits",
    "field",
    "fitting",
    "kernels",
    "lattice",
    "mesh",
    "reference",
    "render",
    "scene",
    "splats",
    "view",
)
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]  (checkers read the stub)


def __getattr__(name: str) -> object:
    if name in _HOMES:
        found = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    elif name in _ROOMS:
        found = importlib.import_module(f".{name}", __name__)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
    globals()[name] = found  # the next time Python finds it by itself
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_ROOMS})
