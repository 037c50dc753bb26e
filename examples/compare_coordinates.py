"""Kinds of coordinates side by side: one leg of a concave cage is lifted, and the other ought to stand still.

    python examples/compare_coordinates.py --out out

Writes coordinates.png to the folder of --out: the figure at rest in its cage, then posed by each kind. The leg that is
not posed is redder where it moves, all red from a twentieth of the figure's width on; how far it does is printed too.
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np
import trimesh
import warp as wp
from PIL import Image, ImageDraw, ImageFont

import warpcage
from warpcage.demo.raycast import render_mesh_views
from warpcage.view.camera import framing_orbit
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import contact_sheet, to_uint8, write_png

KINDS = ("harmonic", "mean_value", "green", "biharmonic", "maximum_likelihood")

GAP = 0.08  # between the legs of a figure that is 1 wide


def two_legs() -> warpcage.Cage:
    """A body on two legs, from the outer sides of a row of boxes."""
    xs, ys, zs = (-0.5, -GAP / 2, GAP / 2, 0.5), (-0.25, 0.25), (-0.8, -0.55, -0.3, 0.0, 0.4)
    boxes = {(i, 0, k) for i in range(3) for k in range(4) if i != 1 or k == 3}
    sides = [[[side if axis == a else 0 for a in range(3)] for side in (1, -1)] for axis in range(3)]
    numbers: dict[tuple, int] = {}
    faces = []
    for place in sorted(boxes):
        for axis, (outwards, inwards) in enumerate(sides):
            for away, high in ((outwards, 1), (inwards, 0)):
                if tuple(np.add(place, away)) in boxes:
                    continue
                corners = []
                for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = np.array(place)
                    corner[axis] += high
                    corner[(axis + 1) % 3] += u
                    corner[(axis + 2) % 3] += v
                    corners.append(numbers.setdefault(tuple(corner), len(numbers)))
                a, b, c, d = corners if high else corners[::-1]
                faces += [[a, b, c], [a, c, d]]
    return warpcage.Cage([(xs[i], ys[j], zs[k]) for i, j, k in numbers], faces)


def figure() -> trimesh.Trimesh:
    """Fine boxes a little inside of the cage."""
    parts = []
    for low, high in (((-0.5, -0.8), (-GAP / 2, 0.2)), ((GAP / 2, -0.8), (0.5, 0.2)), ((-0.5, 0.0), (0.5, 0.4))):
        box = trimesh.creation.box(
            bounds=[(low[0] + 0.03, -0.22, low[1] + 0.03), (high[0] - 0.03, 0.22, high[1] - 0.03)]
        )
        parts.append(box.subdivide_to_size(0.02))
    return trimesh.util.concatenate(parts)


def captioned(picture: np.ndarray, text: str) -> np.ndarray:
    """The picture with a line of text below it."""
    strip = Image.new("RGB", (picture.shape[1], picture.shape[1] // 10), "white")
    font = ImageFont.load_default(size=picture.shape[1] // 15)
    ImageDraw.Draw(strip).text((strip.width / 2, 0), text, fill=(40, 40, 40), font=font, anchor="mt")
    return np.concatenate([picture, np.asarray(strip)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="out", help="folder to write to (default: out)")
    parser.add_argument("--size", type=int, default=300, help="pixels along each side of a picture (default: 300)")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    rest, mesh = two_legs(), figure()
    lifted = (rest.vertices[:, 0] > 0) & (rest.vertices[:, 2] < -0.2)
    turned = warpcage.Cage(rest.vertices - [0.3, 0, -0.1], rest.faces).rotate(-75, axis="y", center=(0, 0, 0)).vertices
    posed = rest.with_vertices(np.where(lifted[:, None], turned + [0.3, 0, -0.1], rest.vertices))
    other = (mesh.vertices[:, 0] < 0) & (mesh.vertices[:, 2] < 0)
    camera = framing_orbit(
        np.concatenate([rest.vertices, posed.vertices]), 1, elevation_degrees=12, start_degrees=-75,
        width=args.size, height=args.size,
    )[0]  # fmt: skip

    def drawn(vertices, cage, name):
        reach = np.where(other, np.linalg.norm(vertices - mesh.vertices, axis=1), 0.0)
        red = np.minimum(reach[mesh.faces].mean(axis=1) / 0.05, 1.0)[:, None]
        rgba = render_mesh_views(
            vertices, mesh.faces, (1 - red) * (0.88, 0.85, 0.78) + red * (0.80, 0.10, 0.05), [camera]
        )[0]
        picture = draw_cage(rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:], camera, cage, width=args.size / 300)
        panels.append(captioned(to_uint8(picture), name))
        return reach

    panels: list[np.ndarray] = []
    drawn(mesh.vertices, rest, "at rest")
    for kind in KINDS:
        reach = drawn(warpcage.deform_points(mesh.vertices, rest, posed, coordinates=kind), posed, kind)[other]
        print(
            f"{kind:18s} moves the other leg by {reach.mean():.4f} of its width on average, at most {reach.max():.4f}"
        )
    path = pathlib.Path(args.out) / "coordinates.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, contact_sheet(panels, columns=len(panels)))
    print(f"wrote {path}: at rest, {', '.join(KINDS)}")


if __name__ == "__main__":
    main()
