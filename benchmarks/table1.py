"""The paper's Table 1 and Fig. 8: seconds a frame for each kind of coordinates and resolution, and what it looks like.

    python benchmarks/table1.py --data ../shared/data/lego_800 --cage lego_42.obj --device cuda:0 \\
        --json docs/results/table1.json --figure docs/pictures/table1.jpg
    python benchmarks/table1.py --quick

A frame is a new pose, never seen before (checks, coordinates, map, marks), and its picture at 800x800 with 512 samples
a ray, as the paper counts it: samples are 1/512 of the longest way through the deformed scene's box apart. Median of
frames of a bend that swings, on a GPU after one whole swing, device idle before and after each. "precise" evaluates the
closed forms at every sample. PSNR is that of one pose's picture against precise; harmonic coordinates have no closed
form and are compared with the finest lattice (512 cells). Without --data the scene is the brick model, as it is with
--quick, small and on the CPU.
"""

from __future__ import annotations

import argparse
import tempfile

import numpy as np
import warp as wp
from results import write_jpeg, write_results
from timing import median_seconds

import warpcage
from warpcage.reference.brick_scene import write_brick_scene
from warpcage.view.pictures import contact_sheet

KINDS = ("mean_value", "harmonic", "green")
FINEST = 512

#: Poses of a swing: once through it before the clock counts, on a GPU, so that graphs have room for all of them.
SWING = 9

#: Seconds a frame of the paper's Table 1 (one A100).
PAPER = {
    "mean_value": {64: 0.31, 128: 0.98, 256: 5.71, None: 102.0},
    "harmonic": {64: 0.23, 128: 0.90, 256: 6.32},
    "green": {64: 0.35, 128: 2.49, 256: 19.69, None: 243.0},
}

#: The authors' code on an H200 (DESIGN, section 5): seconds of a lattice with a 42-vertex cage, and of a render at
#: 800x800 with 512 samples once the lattice is ready, whose middle of 0.550 to 0.576 is added.
AUTHORS_LATTICE = {
    "mean_value": {64: 0.020, 128: 0.170, 256: 1.390},
    "harmonic": {64: 0.490, 128: 1.240, 256: 1.650},
    "green": {64: 0.100, 128: 0.770, 256: 6.140},
}
AUTHORS_RENDER = 0.563


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = warpcage.core.devices.resolve_device(args.device)
    if args.field:
        field, test_psnr, scene = warpcage.VoxelField.load(args.field, device=device), None, args.scene
    else:
        field, test_psnr, scene = prepared_field(args, device)
    rest = warpcage.Cage.load(args.cage) if args.cage else warpcage.Cage.from_field(field, vertex_count=42)
    camera = warpcage.turntable(
        field.center,
        args.distance * np.ptp(field.bounds, axis=0).max(),
        30,
        1,
        fov_degrees=39.6,
        width=args.size,
        height=args.size,
        start_degrees=args.view,
    )[0]
    shown = rest.bend(args.bend, axis="y", towards="z").twist(15)
    step = longest_way(field, rest, shown) / args.samples
    rows, pictures = [], {}
    for kind in KINDS:
        finest = FINEST if not args.quick else 2 * max(args.resolution)
        references = [None] if kind != "harmonic" else [finest]
        for resolution in [*args.resolution, *references]:
            deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=resolution)
            seconds = median_seconds(
                NewPoses(deformer, rest, camera, step, args.bend),
                device,
                runs=args.runs,
                warm=SWING if device.is_cuda else 2,
            )
            frame = deformer.pose(shown).render(camera, step=step)
            pictures[kind, resolution] = np.clip(frame.rgb, 0, 1)
            rows.append(
                {
                    "kind": kind,
                    "resolution": resolution,
                    "seconds": seconds,
                    "paper_a100": PAPER[kind].get(resolution),
                    "authors_h200": authors_seconds(kind, resolution),
                    "outside_pixels": int((frame.outside > 0).sum()),
                }
            )
            print(rows[-1], flush=True)
    for row in rows:
        reference = pictures[row["kind"], None if row["kind"] != "harmonic" else finest]
        psnr = float(warpcage.psnr(pictures[row["kind"], row["resolution"]], reference))
        row["psnr_to_reference"] = psnr if np.isfinite(psnr) else None
    for row in rows:
        print(row)
    if args.json:
        write_results(
            args.json,
            device,
            scene=scene,
            size=args.size,
            samples=args.samples,
            step=step,
            cage_vertices=len(rest.vertices),
            cage_faces=len(rest.faces),
            voxels=field.voxel_count,
            field_resolution=list(field.resolution),
            field_psnr=test_psnr,
            harmonic_reference=finest,
            rows=rows,
        )
    if args.figure:
        write_jpeg(args.figure, figure(pictures, args.resolution, args.crop))


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="scene folder to fit; default: the brick model")
    parser.add_argument("--field", help="a fitted field instead")
    parser.add_argument("--scene", help="what that field is of")
    parser.add_argument("--cage", help="cage file of 42 vertices; default: one is made around the field")
    parser.add_argument("--quality", default="fast", help="of the fit")
    parser.add_argument("--device", default=None)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--resolution", type=int, nargs="*", default=[64, 128, 256])
    parser.add_argument("--bend", type=float, default=40.0)
    parser.add_argument("--view", type=float, default=30.0, help="degrees around the object")
    parser.add_argument("--distance", type=float, default=1.75, help="of the camera, times the field's longest side")
    parser.add_argument(
        "--crop",
        type=float,
        nargs=4,
        default=[0.34, 0.32, 0.66, 0.64],
        help="part of the picture that the figure shows: left, top, right, bottom, 0 to 1",
    )
    parser.add_argument("--runs", type=int, default=2 * SWING)
    parser.add_argument("--json")
    parser.add_argument("--figure", help="JPEG file: rows are kinds, columns resolutions and the reference")
    parser.add_argument("--quick", action="store_true", help="small, on the CPU")
    args = parser.parse_args()
    if args.quick:
        args.device, args.size, args.samples, args.runs = "cpu", 60, 128, 1
        args.resolution = [16, 32]
    return args


def prepared_field(args, device):
    """The fitted field, its PSNR on test views, and the scene's name."""
    with tempfile.TemporaryDirectory() as folder:
        size = 48 if args.quick else 400
        data = args.data or write_brick_scene(
            folder + "/bricks", train_views=30 if args.quick else 80, size=size, device=device
        )
        field = warpcage.fit(warpcage.load_scene(data), device=device, quality=args.quality, progress=False)
        test = warpcage.load_scene(data, split="test")
        psnr = warpcage.mean_psnr(warpcage.evaluate(field, test))
        return field, psnr, "Lego, 800x800" if args.data else f"bricks, {size}x{size}"


def longest_way(field, rest, deformed) -> float:
    """Diagonal of the box around the field and both cages, world units."""
    corners = np.concatenate([field.bounds, rest.bounds, deformed.bounds])
    return float(np.linalg.norm(np.ptp(corners, axis=0)))


def authors_seconds(kind, resolution):
    lattice = AUTHORS_LATTICE[kind].get(resolution)
    return None if lattice is None else lattice + AUTHORS_RENDER


class NewPoses:
    """Frames of a swinging bend; each call poses a cage that was not posed before."""

    def __init__(self, deformer, rest, camera, step, bend):
        self.deformer, self.rest, self.camera, self.step, self.bend, self.turn = deformer, rest, camera, step, bend, 0

    def __call__(self):
        self.turn += 1
        share = 0.6 + 0.4 * np.cos(0.7 * self.turn)
        posed = self.rest.bend(share * self.bend, axis="y", towards="z").twist(15)
        self.deformer.pose(posed).render(self.camera, step=self.step)


def figure(pictures, resolutions, crop) -> np.ndarray:
    """A crop of each picture; the last column is precise, or for harmonic coordinates the finest lattice."""
    cells = []
    for kind in KINDS:
        last = max((r for k, r in pictures if k == kind and r is not None)) if kind == "harmonic" else None
        for resolution in [*resolutions, last]:
            picture = pictures[kind, resolution]
            h, w = picture.shape[:2]
            cells.append(picture[int(crop[1] * h) : int(crop[3] * h), int(crop[0] * w) : int(crop[2] * w)])
    return contact_sheet(cells, columns=len(resolutions) + 1)


if __name__ == "__main__":
    main()
