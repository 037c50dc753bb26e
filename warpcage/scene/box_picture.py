"""A picture of where the object of a scene is: its cameras, points and box from three sides."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..view.camera import Camera
from .box import FoundBox, central_points

#: Side of a view, pixels, and how much finer it is drawn before it is shrunk; the gap between views, height of text.
SIDE, FINER, GAP, TEXT = 400, 3, 8, 15

#: What of the cameras a view shows at least, percent, and what it has beyond that and the box, of the longest side.
SHOWN, BEYOND = (2.0, 98.0), 0.1

#: Length of an optical axis and of a mark, of the side of a view.
AXIS, MARK = 0.05, 0.015

#: Of points, of those in the middle of the pictures, of the box, and of the cameras of each look and of none.
POINT, CENTRAL, BOX = (205, 205, 205), (110, 110, 110), (200, 30, 30)
LOOKS, ALONE = ((30, 100, 200), (230, 140, 0), (20, 140, 70)), (150, 80, 170)

#: Axes of the world to the right and upwards in each view.
VIEWS = ((0, 1), (0, 2), (1, 2))


def draw_box(cameras: Sequence[Camera], points: np.ndarray | None, found: FoundBox) -> np.ndarray:
    """Cameras as short axes, points (n, 3), box and what is looked at, from three sides, over the reason.
    (h, w, 3) float32; cameras have a colour for what they look at, points in the middle of pictures are darker."""
    from PIL import Image, ImageDraw, ImageFont

    centers = np.stack([camera.center for camera in cameras])
    low, high = np.percentile(centers, SHOWN, axis=0)
    low, high = np.minimum(low, found.bounds[0]), np.maximum(high, found.bounds[1])
    size = (1.0 + 2.0 * BEYOND) * float((high - low).max())
    corner = (low + high - size) / 2
    places = np.zeros((0, 3)) if points is None else points
    point_colors = np.full((len(places), 3), POINT)
    colors = [ALONE] * len(cameras)
    for look, color in zip(found.looks, LOOKS, strict=False):
        looking = [cameras[index] for index in look.cameras]
        point_colors[central_points(looking, look.point, places)] = CENTRAL
        for index in look.cameras:
            colors[index] = color
    order = np.argsort(-point_colors[:, 0], kind="stable")  # dark ones over light ones
    views = []
    for right, up in VIEWS:

        def pixel(place: np.ndarray, right: int = right, up: int = up) -> np.ndarray:
            across = (place[..., [right, up]] - corner[[right, up]]) / size
            return np.stack([across[..., 0], 1.0 - across[..., 1]], axis=-1) * SIDE * FINER

        pixels = np.full((SIDE * FINER, SIDE * FINER, 3), 255, np.uint8)
        _draw_points(pixels, pixel(places[order]), point_colors[order])
        view = Image.fromarray(pixels)
        draw = ImageDraw.Draw(view)
        for camera, center, color in zip(cameras, centers, colors, strict=True):
            end = center + AXIS * size * camera.rotation[:, 2]
            draw.line([*pixel(center), *pixel(end)], fill=color, width=FINER)
            x, y = pixel(center)
            draw.ellipse([x - 2 * FINER, y - 2 * FINER, x + 2 * FINER, y + 2 * FINER], fill=color)
        x, y = np.sort(pixel(found.bounds), axis=0).T
        draw.rectangle([x[0], y[0], x[1], y[1]], outline=BOX, width=2 * FINER)
        for look in found.looks:
            x, y = pixel(look.point)
            mark = MARK * SIDE * FINER
            draw.line([x - mark, y, x + mark, y], fill=BOX, width=2 * FINER)
            draw.line([x, y - mark, x, y + mark], fill=BOX, width=2 * FINER)
        name = ImageFont.load_default(size=TEXT * FINER)
        draw.text((4 * FINER, 2 * FINER), f"{'xyz'[right]} right, {'xyz'[up]} up", fill=(90, 90, 90), font=name)
        views.append(view.resize((SIDE, SIDE), Image.Resampling.BOX))
    return captioned(views, [f"box: {box_text(found.bounds)}, {found.reason}"], 235)


def captioned(views: Sequence[Any], lines: Sequence[str], ground: int) -> np.ndarray:
    """PIL images of one height beside each other over lines of text, on a grey of 0 to 255, as (h, w, 3) float32."""
    from PIL import Image, ImageDraw, ImageFont

    font, height = ImageFont.load_default(size=TEXT), views[0].height
    width = GAP + sum(view.width + GAP for view in views)
    letters = int((width - 2 * GAP) / font.getlength("n"))
    rows = [row for line in lines for row in textwrap.wrap(line, letters)]
    sheet = Image.new("RGB", (width, height + 3 * GAP + round(1.4 * TEXT * len(rows))), (ground, ground, ground))
    left = GAP
    for view in views:
        sheet.paste(view, (left, GAP))
        left += view.width + GAP
    for number, row in enumerate(rows):
        place = (GAP, height + 2 * GAP + round(1.4 * TEXT * number))
        ImageDraw.Draw(sheet).text(place, row, fill=(30, 30, 30), font=font)
    return np.asarray(sheet, np.float32) / 255.0


def box_text(bounds: np.ndarray) -> str:
    """The sides and the middle of a box (2, 3) as text."""
    sides, middle = np.ptp(bounds, axis=0), bounds.mean(axis=0)
    digits = max(0, 2 - int(np.floor(np.log10(sides.max()))))
    numbers = (", ".join(f"{value:.{digits}f}" for value in middle + 0.0), " x ".join(f"{s:.{digits}f}" for s in sides))
    return f"{numbers[1]} about ({numbers[0]})"


def _draw_points(pixels: np.ndarray, places: np.ndarray, point_colors: np.ndarray) -> None:
    """Squares of a pixel of the view at places (n, 2), those outside left out."""
    corners = np.floor(places).astype(np.int64)
    for down in range(FINER):
        for right in range(FINER):
            x, y = (corners + [right, down]).T
            seen = (x >= 0) & (y >= 0) & (x < pixels.shape[1]) & (y < pixels.shape[0])
            pixels[y[seen], x[seen]] = point_colors[seen]
