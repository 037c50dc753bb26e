"""Pictures of given files: splats as they are drawn, scenes with their points, meshes, to be looked at."""

from __future__ import annotations

import argparse
import pathlib
import warnings
from collections.abc import Iterator

import numpy as np
from common import DEVICE, command, option

#: Height of the line with a name, pixels, and diameter of a point.
LINE, DOT = 16, 2


@command(
    option(
        "folder", type=pathlib.Path, help="folder of files and of scene folders, which are looked for two levels deep"
    ),
    option("--out", default="files.png", help="picture to write (default: %(default)s)"),
    option("--side", type=int, default=360, help="pixels of a side of each (default: %(default)s)"),
    option("--columns", type=int, help="how many stand beside each other (default: as many as rows)"),
    DEVICE,
)
def main(args: argparse.Namespace) -> None:
    """One picture of everything in a folder that warpcage reads, with names: what is turned, mirrored, washed out or
    empty stands out.

        python benchmarks files ../shared/data --out files.png

    Splats and meshes are looked at from the front and a little above, by their own direction up. Of a scene it shows
    the first picture, and beside it the points of the reconstruction in that camera, or the box of the object where
    it has none.
    """
    from warpcage.view.pictures import contact_sheet, write_png

    panels = []
    for path in given_files(args.folder):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                drawn = pictures_of(path, args.side, args.device)
            except ValueError as error:
                print(f"{path}: {error}")
                continue
        for name, picture in drawn.items():
            panels.append(labelled(picture, f"{path.relative_to(args.folder)} {name}".strip(), args.side))
        print(path, *(f"  {each.message}" for each in caught), sep="\n")
    write_png(args.out, contact_sheet(panels, columns=args.columns, background=0.5))
    print(f"{args.out}: {len(panels)} pictures")


def given_files(folder: pathlib.Path) -> Iterator[pathlib.Path]:
    """Files and folders that may be read; folders that are neither splats nor scenes are looked into."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not is_read(path):
            yield from (each for each in sorted(path.iterdir()) if is_read(each))
        elif is_read(path):
            yield path


def is_read(path: pathlib.Path) -> bool:
    """Whether a path is a file of splats or of a mesh, or a scene."""
    from warpcage.mesh.io.formats import mesh_endings
    from warpcage.scene.formats.table import scene_formats
    from warpcage.splats.io import is_splat_file

    if is_splat_file(path):
        return True
    if path.is_dir():
        return any(each.is_scene(path) for each in scene_formats())
    return path.suffix.lower() in mesh_endings()


def pictures_of(path: pathlib.Path, side: int, device: str | None) -> dict[str, np.ndarray]:
    """Pictures (h, w, 3) of a file by what stands behind its name."""
    import warpcage
    from warpcage.splats.io import is_splat_file, splat_path

    if is_splat_file(path):
        field = warpcage.SplatField.load(splat_path(path), device=device)
        return {f"({len(field)})": drawn_splats(field, side)}
    if path.is_dir():
        return scene_pictures(path, side)
    return {"": drawn_mesh(warpcage.Cage.load(path), side)}


def drawn_splats(field, side: int) -> np.ndarray:
    """Splats from the front and above, on grey."""
    low, high = field.shown_bounds
    camera = front_camera(np.stack([low, high]), field.up, side)
    return field.render(camera, background=(0.35, 0.35, 0.4)).rgb


def drawn_mesh(mesh, side: int) -> np.ndarray:
    """The edges of a mesh from the front and above."""
    from warpcage.view.overlay import draw_cage

    camera = front_camera(mesh.vertices, (0.0, 0.0, 1.0), side)
    return draw_cage(np.ones((side, side, 3), np.float32), camera, mesh)


def front_camera(points: np.ndarray, up, side: int):
    """A camera that sees all points, a box by its corners."""
    from warpcage.view.camera import framing_orbit

    if len(points) == 2:
        low, high = points
        points = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return framing_orbit(points, 1, up=up, width=side, height=side, start_degrees=-60.0)[0]


def scene_pictures(folder: pathlib.Path, side: int) -> dict[str, np.ndarray]:
    """The first picture of a scene, and the same with what is known of where objects are."""
    from warpcage import load_scene

    width = first_width(folder)
    scene = load_scene(folder, split="train", downscale=max(1, -(-width // side)), format=None)
    camera = scene.cameras[0]
    picture = np.asarray(scene.cut(0, scene.images[0]))
    over = picture * 0.35
    if scene.points is not None:
        colors = np.full((len(scene.points), 3), (1.0, 0.9, 0.2)) if scene.point_colors is None else scene.point_colors
        draw_points(over, camera, scene.points, colors)
        what = f"{len(scene.points)} points"
    else:
        from warpcage import Cage
        from warpcage.scene.box import scene_box
        from warpcage.view.overlay import draw_cage

        over = draw_cage(over, camera, Cage.box(*scene_box(scene).bounds))
        what = "box"
    return {f"{scene.names[0]} of {len(scene)}": picture, what: over}


def first_width(folder: pathlib.Path) -> int:
    """The longer side of the first picture that is found in a scene, pixels."""
    from warpcage.scene.parsing import PICTURE_ENDINGS
    from warpcage.view.pictures import image_size

    files = (path for path in sorted(folder.rglob("*")) if path.suffix.lower() in PICTURE_ENDINGS)
    return max(image_size(next(files)))


def draw_points(picture: np.ndarray, camera, points: np.ndarray, colors: np.ndarray) -> None:
    """Squares of DOT pixels where points are seen, the nearest last."""
    pixels, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        seen = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    order = np.flatnonzero(seen)[np.argsort(-depth[seen])]
    column, row = pixels[order].astype(int).T
    for y in range(DOT):
        for x in range(DOT):
            picture[np.minimum(row + y, camera.height - 1), np.minimum(column + x, camera.width - 1)] = colors[order]


def labelled(picture: np.ndarray, name: str, side: int) -> np.ndarray:
    """A picture in the middle of a square, its name above it."""
    from PIL import Image, ImageDraw

    panel = np.full((side + LINE, side, 3), 0.5, np.float32)
    height, width = min(picture.shape[0], side), min(picture.shape[1], side)
    top, left = LINE + (side - height) // 2, (side - width) // 2
    panel[top : top + height, left : left + width] = picture[:height, :width]
    drawn = Image.fromarray((panel * 255).clip(0, 255).astype(np.uint8))
    ImageDraw.Draw(drawn).text((3, 2), name[: side // 6], fill=(255, 255, 255))
    return np.asarray(drawn, np.float32) / 255
