"""The demo: the excavator of bricks, rendered, fitted and caged once, and kept for the next time."""

from __future__ import annotations

import os
import pathlib
import sys
import tempfile

import warp as wp

from ...cage.cage import Cage
from ...core.files import atomic_path
from ...demo.brick_scene import write_brick_scene
from ...fitting.fit import fit
from ...scene.load import load_scene

#: Pictures and pixels of their sides that the demo is fitted to, and vertices of its cage.
VIEWS, SIZE, VERTICES = 60, 100, 100


def demo_files(device: wp.Device) -> tuple[pathlib.Path, pathlib.Path]:
    """The demo's field and cage, made where they are not there yet: in a minute and a half on two cores."""
    folder = demo_folder()
    field_path, cage_path = folder / "bricks.npz", folder / "bricks_cage.obj"
    if field_path.is_file() and cage_path.is_file():
        return field_path, cage_path
    print(f"making the demo, once, in {folder}", file=sys.stderr)
    with tempfile.TemporaryDirectory() as temporary:
        write_brick_scene(pathlib.Path(temporary) / "scene", train_views=VIEWS, size=SIZE, device=device)
        field = fit(load_scene(pathlib.Path(temporary) / "scene"), device=device, seed=0)
    cage = Cage.from_field(field, VERTICES)
    with atomic_path(cage_path) as path:
        cage.save(path)
    with atomic_path(field_path) as path:
        field.save(path)
    return field_path, cage_path


def demo_folder() -> pathlib.Path:
    """Where the demo is kept: WARPCAGE_CACHE, else warpcage/ in the user's folder for caches."""
    if "WARPCAGE_CACHE" in os.environ:
        return pathlib.Path(os.environ["WARPCAGE_CACHE"])
    import platformdirs

    return pathlib.Path(platformdirs.user_cache_dir("warpcage", appauthor=False))
