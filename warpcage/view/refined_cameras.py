"""Cameras and exposures that a fit refined, and their file."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from ..core.files import PathLike
from .camera import Camera
from .camera_file import CameraFile
from .camera_path import CameraKey


@dataclasses.dataclass(frozen=True, eq=False)
class RefinedCameras:
    """The cameras of a fit's pictures as it refined them."""

    names: list[str]
    # in the field's world
    cameras: list[Camera]
    # (n, 3) float64, what the field's red, green and blue are multiplied by in each picture
    gains: np.ndarray
    # (n, 3) float64, what is added to them then
    offsets: np.ndarray

    def __len__(self) -> int:
        return len(self.cameras)

    def save(self, path: PathLike) -> pathlib.Path:
        """Write them as a camera file, whole or not at all, which `load_scene(path, cameras=...)` takes for its
        pictures."""
        keys = [CameraKey(camera, name=name) for name, camera in zip(self.names, self.cameras, strict=True)]
        pairs = zip(self.gains, self.offsets, strict=True)
        # an `exposure` with gain and offset for each, which readers of cameras pass over
        extras = [{"exposure": {"gain": gain.tolist(), "offset": offset.tolist()}} for gain, offset in pairs]
        CameraFile(keys).save(path, extras=extras)
        return pathlib.Path(path)
