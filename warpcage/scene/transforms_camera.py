"""One camera of a transforms.json, without its pictures."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ..core.checks import listed
from ..core.files import PathLike, require_file
from ..view.camera import Camera
from ..view.pictures import image_size
from .formats.parsing import TO_OPENCV, find_picture, frames_of, matrix, number, read_json
from .formats.transforms import frame_intrinsics


class TransformsCameras:
    """The cameras of a transforms.json, of NeRF-synthetic scenes, nerfstudio or instant-ngp."""

    def __init__(self, path: PathLike):
        self.path = require_file(path, "camera file")
        self._content = read_json(self.path)
        self._frames = frames_of(self._content, self.path)

    def __len__(self) -> int:
        return len(self._frames)

    def camera(self, name: str, size: tuple[int, int] | None = None) -> Camera:
        """The camera of a frame, in the world of the file: by number from 0, or by its picture, with or without folder
        and ending. size: width and height where the file does not say them; None takes those of the picture."""
        where, frame = self._found(name)
        given = {**{key: value for key, value in self._content.items() if key != "frames"}, **frame}
        if "w" in given and "h" in given:
            width, height = (int(number(given[side], f"{where}: {side}")) for side in "wh")
        elif size is not None:
            width, height = size
        else:
            width, height = image_size(find_picture(self.path.parent, frame.get("file_path"), f"{where}: file_path"))
        fx, fy, cx, cy = frame_intrinsics(given, (width, height), where)
        rows = frame.get("transform_matrix")
        if isinstance(rows, list) and len(rows) == 3:
            rows = [*rows, [0.0, 0.0, 0.0, 1.0]]
        pose = matrix(rows, (4, 4), f"{where}: transform_matrix") @ TO_OPENCV
        try:
            return Camera(fx, fy, cx, cy, width, height, np.asarray(pose))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None

    def _found(self, name: str) -> tuple[str, dict[str, Any]]:
        if name.isdigit() and int(name) < len(self._frames):
            return self._frames[int(name)]
        names = [str(frame.get("file_path")) for _, frame in self._frames]
        short = [pathlib.PurePosixPath(each).stem for each in names]
        chosen = [index for index, each in enumerate(names) if name in (each, short[index])]
        if len(chosen) == 1:
            return self._frames[chosen[0]]
        wrong = f"{len(chosen)} frames" if chosen else "no frame"
        raise ValueError(f"{self.path} has {wrong} {name!r}, only 0 to {len(names) - 1}: {listed(short)}")
