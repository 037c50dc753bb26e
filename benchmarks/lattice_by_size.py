"""What a coarser lattice costs in a picture, by the picture's size: the rule of the command line's --resolution.

    python benchmarks/lattice_by_size.py --field bricks.npz --cage bricks_cage.obj --json lattice_by_size.json

The demo (`warpcage edit --demo` makes both files), bent and twisted, is rendered at several sizes over lattices of
several numbers of cells along the longest side of the cage, and compared with one of --fine cells: PSNR over the
object's pixels, and the share of them that differ by more than 8 of 255. Times are CPU times of the pose and of the
frame, after a first one, and mean something beside one another alone.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import platform
import time

import numpy as np

import warpcage
from warpcage.view.camera import framing_orbit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", required=True)
    parser.add_argument("--cage", required=True)
    parser.add_argument("--sizes", type=int, nargs="+", default=[80, 160, 320, 640])
    parser.add_argument("--cells", type=int, nargs="+", default=[24, 32, 48, 64, 96, 128])
    parser.add_argument("--fine", type=int, default=192)
    parser.add_argument("--coordinates", nargs="+", default=["harmonic", "mean_value"])
    parser.add_argument("--json", help="write the figures to this file")
    args = parser.parse_args()
    field, rest = warpcage.VoxelField.load(args.field), warpcage.Cage.load(args.cage)
    posed = rest.bend(40, axis="x", towards="z").twist(20, axis="z")
    rows = [row for kind in args.coordinates for row in compared(field, rest, posed, kind, args)]
    if args.json:
        about = {"machine": platform.processor() or platform.machine(), "device": str(field.device), "fine": args.fine}
        pathlib.Path(args.json).write_text(json.dumps(about | {"rows": rows}, indent=1) + "\n")


def compared(field, rest, posed, kind: str, args) -> list[dict]:
    """One row for each number of cells and each size."""
    points = np.concatenate([rest.vertices, posed.vertices])
    cameras = {
        size: framing_orbit(points, 1, elevation_degrees=25, start_degrees=-60, up=field.up, width=size, height=size)[0]
        for size in args.sizes
    }
    truth = {}
    rows = []
    for cells in [args.fine, *args.cells]:
        deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=cells).pose(posed)
        start = time.process_time()
        deformer.pose(posed.translate([1e-3, 0, 0]))
        pose_seconds = time.process_time() - start
        deformer.pose(posed)
        for size, camera in cameras.items():
            deformer.render(camera)
            start = time.process_time()
            frame = deformer.render(camera)
            frame_seconds = time.process_time() - start
            if cells == args.fine:
                truth[size] = frame
                continue
            seen = np.maximum(frame.alpha, truth[size].alpha) > 0.01
            difference = np.abs(frame.rgb - truth[size].rgb)[seen]
            row = {"coordinates": kind, "cells": cells, "size": size, "cells_per_pixel": cells / size,
                   "psnr": float(-10 * np.log10(np.mean(difference**2))),
                   "differ": float((difference.max(axis=-1) > 8 / 255).mean()),
                   "pose_seconds": pose_seconds, "frame_seconds": frame_seconds}  # fmt: skip
            rows.append(row)
            print(
                f"{kind:10s} {cells:4d} cells {size:4d} pixels: {row['psnr']:5.1f} dB, {100 * row['differ']:5.2f} % "
                f"differ, pose {pose_seconds:6.3f} s, frame {frame_seconds:6.3f} s",
                flush=True,
            )
    return rows


if __name__ == "__main__":
    main()
