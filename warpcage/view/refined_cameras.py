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
    """The cameras of a fit's pictures as it refined them.

    Args:
        names: Of the pictures.
        cameras: Of the pictures, in the field's world.
        gains: (n, 3) float64, what the field's red, green and blue are multiplied by in each picture.
        offsets: (n, 3) float64, what is added to them then.
    """

    names: list[str]
    cameras: list[Camera]
    gains: np.ndarray
    offsets: np.ndarray

    def __len__(self) -> int:
        return len(self.cameras)

    def save(self, path: PathLike) -> pathlib.Path:
        """Write them as a camera file, whole or not at all.

        It is what `CameraFile.save` writes, with the names of the pictures, and an `exposure` with gain and offset for
        each, which readers of cameras pass over. `load_scene(path, cameras=...)` gives the cameras to a scene's
        pictures.

        Args:
            path: The file; it must end in .json.

        Returns:
            The path.

        Raises:
            ValueError: For another ending.
        """
        keys = [CameraKey(camera, name=name) for name, camera in zip(self.names, self.cameras, strict=True)]
        pairs = zip(self.gains, self.offsets, strict=True)
        extras = [{"exposure": {"gain": gain.tolist(), "offset": offset.tolist()}} for gain, offset in pairs]
        CameraFile(keys).save(path, extras=extras)
        return pathlib.Path(path)
