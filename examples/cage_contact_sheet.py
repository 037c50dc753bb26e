"""Cages of several sizes around scenes that are hard for them, each drawn over its mesh with the report of its check.

    python examples/cage_contact_sheet.py --out out
    python examples/cage_contact_sheet.py --counts 60 120 --method shell --mesh statue.obj

Writes to the folder of --out: cages.png (one row per scene: the mesh, then its cages), reports.json (all reports in
full) and the cages as <scene>_<count>.obj.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.core.files import atomic_path
from warpcage.demo.bricks import brick_model
from warpcage.demo.cage_scenes import CAGE_SCENES, scene_field
from warpcage.demo.raycast import render_mesh_views
from warpcage.view.camera import framing_orbit
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import contact_sheet, to_uint8, write_png

STONE = (0.62, 0.66, 0.70)


def main(argv=None) -> dict:
    args = parse_arguments(argv)
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    out = pathlib.Path(args.out)
    panels, reports = [], {}
    for name, (scene_object, mesh) in scenes(args).items():
        made = []
        for count in args.counts:
            start = time.perf_counter()
            make = warpcage.Cage.from_mesh if scene_object is mesh else warpcage.Cage.from_field
            cage = make(scene_object, count, method=args.method)
            seconds = time.perf_counter() - start
            report = cage.check(mesh=mesh, field=None if scene_object is mesh else scene_object)
            cage.save(out / f"{name.replace(' ', '_')}_{count}.obj")
            made.append((cage, report, seconds))
            reports[f"{name} {count}"] = report.as_dict() | {"seconds": round(seconds, 2)}
        panels += drawn(name, mesh, made, args.size)
    write_png(out / "cages.png", contact_sheet(panels, columns=1 + len(args.counts)))
    with atomic_path(out / "reports.json") as temporary:
        temporary.write_text(json.dumps(reports, indent=1) + "\n", encoding="utf-8")
    bad = [name for name, report in reports.items() if not trusted(report)]
    print(
        f"wrote {out / 'cages.png'}: {len(reports)} cages, {len(reports) - len(bad)} enclose their objects whole, "
        f"closed, and without crossings; at most {max(report['seconds'] for report in reports.values())} s each"
    )
    if bad:
        raise SystemExit(f"cages that cannot be trusted: {', '.join(bad)}")
    return reports


def scenes(args) -> dict:
    """Name -> (object of the cage, mesh to show), for the five fields and the brick model, or for a mesh file."""
    import trimesh

    if args.mesh is not None:
        mesh = trimesh.load(args.mesh, force="mesh", process=False)
        return {pathlib.Path(args.mesh).stem: (mesh, mesh)}
    found = {}
    for name in args.scenes:
        if name == "bricks":
            vertices, faces, _ = brick_model()
            mesh = trimesh.Trimesh(vertices, faces, process=False)
            found[name] = (mesh, mesh)
        else:
            field = scene_field(name, args.resolution)
            found[name] = (field, field.extract_mesh(components="all"))
    return found


def trusted(report: dict) -> bool:
    shares = [report[name] for name in ("mesh_enclosed", "field_enclosed") if report[name] is not None]
    return report["usable"] and not report["intersecting_faces"] and min(shares) == 1.0


def drawn(name: str, mesh, made, size: int) -> list[np.ndarray]:
    """Panels (size + caption, size, 3) of the mesh alone and with each cage, from one camera that shows all of them."""
    points = np.concatenate([cage.vertices for cage, _, _ in made])
    camera = framing_orbit(points, 1, elevation_degrees=30.0, start_degrees=40.0, width=size, height=size)[0]
    colors = np.broadcast_to(np.array(STONE), np.shape(mesh.faces))
    rgba = render_mesh_views(mesh.vertices, mesh.faces, colors, [camera], samples=3)[0]
    picture = rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]
    panels = [captioned(picture, f"{name}\n{len(mesh.vertices)} vertices\nvolume {abs(mesh.volume):.3g}")]
    for cage, report, seconds in made:
        share = report.mesh_enclosed if report.field_enclosed is None else report.field_enclosed
        crossings = f", {len(report.intersecting_faces)} CROSSINGS" if report.intersecting_faces else ""
        lines = [
            (
                f"{report.vertex_count} vertices, {report.part_count} part{'s' * (report.part_count > 1)}, "
                f"genus {report.genus}{crossings}"
            ),
            f"{100 * share:.4g} % enclosed, hull x {report.hull_ratio:.2f}",
            f"{'usable' if report.usable else 'NOT usable'}, made in {seconds:.1f} s",
        ]
        panels.append(captioned(draw_cage(picture, camera, cage, width=max(1.0, size / 200)), "\n".join(lines)))
    return panels


def captioned(picture, text: str) -> np.ndarray:
    """The picture with up to three lines of text on a strip below it."""
    from PIL import Image, ImageDraw, ImageFont

    size = picture.shape[1]
    font = ImageFont.load_default(size=max(6, size // 19))
    strip = Image.new("RGB", (size, 4 * max(6, size // 18)), "white")
    ImageDraw.Draw(strip).multiline_text((4, 2), text, fill=(40, 40, 40), font=font)
    return np.concatenate([to_uint8(picture), np.asarray(strip)])


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = [*CAGE_SCENES, "bricks"]
    parser.add_argument("--out", default="out", help="folder to write to (default: out)")
    parser.add_argument("--scenes", nargs="+", choices=every, default=every, help="(default: all)")
    parser.add_argument("--mesh", help="a mesh file instead of the scenes")
    parser.add_argument("--counts", nargs="+", type=int, default=[42, 100, 200], help="vertices (default: 42 100 200)")
    parser.add_argument("--method", choices=("auto", "shell", "voxel"), default="auto", help="(default: auto)")
    parser.add_argument("--resolution", type=int, default=64, help="voxels along each side of the fields (default: 64)")
    parser.add_argument("--size", type=int, default=300, help="pixels along each side of a picture (default: 300)")
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
