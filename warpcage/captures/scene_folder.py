"""The folder of a captured scene: pinhole pictures, transforms.json, points, report."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..core.threads import cpu_threads
from .found import Found
from .pinholes import Pinhole, common_size
from .progress import bar
from .sources import Source, load_upright, shrink_factor

#: From OpenCV's camera axes to OpenGL's (+y up, -z forward), which transforms.json has.
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_scene(
    folder: pathlib.Path,
    sources: Sequence[Source],
    sharpness: Sequence[float] | np.ndarray,
    found: Found,
    feature_size: int,  # longer side that pictures were shrunk to where they are longer, pixels
    *,
    progress: bool = False,
) -> tuple[tuple[int, int], int]:
    """Write the pictures that have a camera, their cameras and the points to an empty folder, in nerfstudio's
    conventions. Returns width and height of the pictures as they are written, and how many had another shape before."""
    chosen = [sources[picture] for picture in found.pictures]
    size = common_size([source.size for source in chosen])
    pinholes = _pinholes(chosen, found, size, feature_size)
    (folder / "images").mkdir()
    frames = []
    for source, pinhole, pose, picture in zip(chosen, pinholes, found.poses, found.pictures, strict=True):
        camera = pinhole.camera(pose)
        ending = ".png" if source.lossless else ".jpg"
        frames.append(
            {
                "file_path": f"images/{source.name}{ending}",
                "fl_x": camera.fx,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "w": camera.width,
                "h": camera.height,
                "sharpness": round(float(sharpness[picture]), 4),
                "transform_matrix": (camera.camera_to_world @ TO_OPENGL).tolist(),
            }
        )
    with bar(len(chosen), "undistort", progress) as shown, ThreadPoolExecutor(cpu_threads()) as pool:

        def write(index: int) -> None:
            _write_picture(folder / frames[index]["file_path"], chosen[index], pinholes[index])
            shown.update()

        for pinhole in dict.fromkeys(pinholes):  # by camera, whose table of pixels is large
            members = [index for index, other in enumerate(pinholes) if other is pinhole]
            pinhole.prepare()
            list(pool.map(write, members))
            pinhole.forget()
    write_points(folder / "points.ply", found)
    content = {"camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return size, sum(pinhole.reshaped for pinhole in pinholes)


def write_points(path: pathlib.Path, found: Found) -> None:
    """Write the points of a reconstruction with their colours, as a binary PLY file."""
    kinds = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.zeros(len(found.points), np.dtype(kinds))
    for axis, name in enumerate("xyz"):
        rows[name] = found.points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = found.colours[:, channel]
    properties = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in kinds)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def _pinholes(sources: Sequence[Source], found: Found, size: tuple[int, int], feature_size: int) -> list[Pinhole]:
    """What each picture is resampled by; pictures of one camera share it."""
    made: dict[tuple, Pinhole] = {}
    result = []
    for source, lens, pose in zip(sources, found.lenses, found.poses, strict=True):
        clockwise = bool(pose[2, 0] < 0)  # so that up, +z, is up in the turned picture
        key = (id(lens), source.size, clockwise)
        if key not in made:
            factor = 1.0 / shrink_factor(source.size, feature_size)
            made[key] = Pinhole(lens.enlarged(factor, source.size), size, clockwise=clockwise)
        result.append(made[key])
    return result


def _write_picture(path: pathlib.Path, source: Source, pinhole: Pinhole) -> None:
    from PIL import Image

    picture = Image.fromarray(pinhole.picture(load_upright(source.file)))
    if path.suffix == ".jpg":
        picture.convert("RGB").save(path, quality=95, subsampling=0)
    else:
        picture.save(path, compress_level=4)
