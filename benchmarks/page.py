"""Write the page docs/results.md from the JSON files of the benchmarks.

    python benchmarks/page.py --results docs/results --page docs/results.md

Sections whose file is missing are left out, and named on the way.
"""

from __future__ import annotations

import argparse
import collections
import json
import pathlib

KINDS = {"mean_value": "mean value", "harmonic": "harmonic", "green": "green"}
POSES = ("rigid", "twist", "bend", "stretch", "local")


def main() -> None:
    args = page_arguments(__doc__, "docs/results.md")
    folder = pathlib.Path(args.results)
    parts = [INTRODUCTION]
    sections = {
        "table1.json": table1,
        "ground_truth*.json": ground_truth,
        "coverage.json": coverage,
        "compile*.json": first_start,
    }
    for pattern, section in sections.items():
        files = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(pattern))]
        if files:
            parts += section(files)
        else:
            print(f"no {pattern} in {folder}: section left out")
    if len(parts) == 1:
        raise SystemExit(f"no results in {folder}: run benchmarks/table1.py, ground_truth.py or compile.py first")
    pathlib.Path(args.page).write_text("\n".join(parts), encoding="utf-8")
    print(f"{args.page}: {len(parts)} parts")


INTRODUCTION = """# Measured: the paper's table, and ground truth

Every number on this page was written by a script to a JSON file in [results/](results/), with the machine and the
versions in it; the page is made from them by `python benchmarks/page.py`.
"""


def page_arguments(description: str | None, page: str) -> argparse.Namespace:
    """The folder of results, and the page that is made of them."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", default="docs/results")
    parser.add_argument("--page", default=page)
    return parser.parse_args()


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def source(results: dict) -> str:
    """The command, and what it ran on."""
    machine = results["machine"]
    on = machine["device"] if machine["device"] != "CPU" else f"{machine['processor']}, {machine['cores']} cores"
    cuda = f", driver for CUDA {machine['cuda_driver']}" if "cuda_driver" in machine else ""
    return (
        f"`{results['command']}`\n({on}{cuda}, Python {machine['python']}, Warp {machine['warp']}, "
        f"NumPy {machine['numpy']})\n"
    )


def cells(resolution) -> str:
    return "precise" if resolution is None else f"{resolution}³"


# Table 1


def table1(files) -> list[str]:
    results = files[0]
    rows = []
    for row in results["rows"]:
        paper, authors = ("–" if row[name] is None else f"{row[name]:g}" for name in ("paper_a100", "authors_h200"))
        psnr = "reference" if row["psnr_to_reference"] is None else f"{row['psnr_to_reference']:.1f}"
        rows.append([KINDS[row["kind"]], cells(row["resolution"]), f"**{row['seconds']:.4f}**", paper, authors, psnr])
    return [
        f"""## Table 1: seconds a frame

Scene: {results["scene"]}, {results["voxels"]:,} voxels; {results["size"]}x{results["size"]} pixels,
{results["samples"]} samples a ray across the deformed scene's box; cage of {results["cage_vertices"]} vertices. A frame
is a new pose (checks, coordinates, lattice, marks) and its picture; median. PSNR is that of one pose's picture against
the one with the closed form evaluated at every sample that may show something ("precise"); harmonic coordinates have
none and are compared with {results["harmonic_reference"]}³. The cage is told in benchmarks/NOTES-proof.md. The
paper's figures are of one A100; those of the authors'
code, on one H200, are its lattice plus its render with the lattice ready. Green maps lead out of the rest cage in
places: where a fit leaves a speck of matter at the cage's face, two lattices may cut it differently, and those few
pixels then decide their PSNR.
""",
        table(
            ["coordinates", "lattice", "warpcage, s", "paper, s (A100)", "authors' code, s (H200)", "PSNR, dB"], rows
        ),
        source(results),
        """![Rows: coordinates; columns: 64, 128, 256, precise](pictures/table1.jpg)

The paper's Fig. 8: rows are mean value, harmonic and green coordinates; columns 64³, 128³, 256³ and precise (harmonic:
512³). Made by the command above with `--figure`.
""",
    ]


# Ground truth


def ground_truth(files) -> list[str]:
    scenes = [scene for results in files for scene in results["scenes"]]
    rows = [row for results in files for row in results["rows"]]
    middle = files[0]["middle"]
    ceilings = {scene["scene"]: scene for scene in scenes}
    plain = [row for row in rows if row["what"] == "frame"]
    poses = [pose for pose in POSES if any(row["pose"] == pose for row in rows)]
    parts = [
        TRUTH,
        "### The ceiling: the field at rest\n",
        table(
            ["scene", "voxels", "PSNR, dB", "SSIM", "depth error"],
            [
                [
                    name,
                    f"{scene['voxels']:,}",
                    f"{scene['psnr']:.2f}",
                    f"{scene['ssim']:.4f}",
                    f"{1e3 * scene['depth_mean']:.1f} ‰",
                ]
                for name, scene in ceilings.items()
            ],
        ),
        "### Deformed: PSNR in dB, and how far from the ceiling\n",
    ]
    body = []
    for name in ceilings:
        for pose in poses:
            for kind in KINDS:
                found = {
                    row["resolution"]: row
                    for row in plain
                    if (row["scene"], row["pose"], row["kind"]) == (name, pose, kind)
                }
                if found:
                    at = found[middle]
                    body.append(
                        [
                            name,
                            pose,
                            KINDS[kind],
                            *(difference(found.get(r)) for r in (64, 128, 256, None)),
                            f"{at['psnr']:.2f}",
                            f"{at['ssim']:.4f}",
                            f"{1e3 * at['depth_mean']:.1f} ‰",
                            "{:.2f}–{:.2f}".format(*at["stretch"]),
                        ]
                    )
    worst = min((row for row in plain if row["resolution"] == middle), key=lambda row: row["to_ceiling"])
    parts += [
        table(
            [
                "scene",
                "pose",
                "coordinates",
                "64³",
                "128³",
                "256³",
                "precise",
                f"PSNR at {middle}³",
                "SSIM",
                "depth error",
                "stretch",
            ],
            body,
        ),
        f"The farthest from the ceiling at {middle}³: {worst['to_ceiling']:+.2f} dB ({worst['scene']}, "
        f"{worst['pose']}, {KINDS[worst['kind']]}). Columns of lattices are dB relative to the scene's ceiling; "
        "depth errors are means over pixels that truth and field cover, per mille of the cage's size; stretch is "
        "the range of the singular values of the pose at the object.\n",
        *[source(results) for results in files],
        "\n".join(
            f"![{name}: rest, truth, deformed field, five times the difference](pictures/ground_truth_{name}.jpg)\n"
            for name in ceilings
        ),
        "From left to right: truth at rest, truth of the pose, deformed field (harmonic, "
        f"{middle}³), five times their difference on white. Made by the commands above with `--figures`.\n",
        OWN_FITS,
        own_fits(rows, middle),
        CAUSES,
        differences(rows, middle, ["frame", "truth turned", "truth relit", "half step", "density paper"]),
        SHORTCUTS,
        costs(rows, middle),
    ]
    return parts


def coverage(files) -> list[str]:
    results = files[0]
    rows = [
        [row["scene"], row["pose"], f"{row['rest']:.3f}", f"{row['posed']:.3f}", f"{row['decibels']:+.2f}"]
        for row in results["rows"]
    ]
    return [
        COVERAGE,
        table(["scene", "pose", "covered at rest", "covered posed", "dB by coverage alone"], rows),
        source(results),
    ]


COVERAGE = """### What the pictures themselves change

The ceiling is of other pictures than those of a pose: an object that fills more of them lowers the PSNR by as much as
its share grows, whatever the field.
"""


TRUTH = """## Ground truth

Three models of the project's own (bricks, an animal, a chair of rods), textured and partly specular, are ray cast at
rest, a field is fitted to these pictures, a cage of 60 vertices is posed, and the deformed field is compared with ray
cast pictures of the posed model. What the posed model is:

- **Where it is.** A deformed field shows at x what the field holds at phi(x), phi made of coordinates of the *deformed*
  cage. So each vertex p of the model goes where phi(x) = p: Newton's iteration in float64 finds it, from closed forms
  (mean value, green) or boundary elements (harmonic). The usual way with meshes, coordinates of the rest cage applied
  to the deformed one, is another map.
- **How it is lit.** A field holds the light that fell on the object when it was captured. So the truth carries colour,
  shadows and highlights along with the matter; highlights are seen along J d, J the Jacobian of phi: the limit of the
  paper's Eq. 4. Two other truths stand further below.
"""

OWN_FITS = """### Against fields of the poses themselves

The ceiling above is of other pictures than those of a pose. Here a field is fitted to as many pictures of the pose
itself, from around it, and shown from the same test views: what a field can show of this very scene at all. PSNR in dB,
harmonic coordinates.
"""

CAUSES = """### What the rest of the difference is made of

Harmonic coordinates; dB relative to the ceiling, mean over the scenes that were measured. "turned": highlights go along
with the rotation nearest to J instead of J. "relit": the posed object lit by lights that stay where they are, which no
captured field can show. "half step": half the march step. "density paper": sigma as the paper's Eq. 5 has it.
"""

SHORTCUTS = """### What shortcuts cost

The same scenes, harmonic, with shortcuts that earlier code takes, switched on in the benchmark only; dB that each
costs. "nearest voxel": boundary values at the lattice nodes nearest to the cage, instead of at the crossings of grid
edges (converged all the same). "weight sum": weights are zero outside the cage, inside is where their interpolated sum
exceeds a threshold (0.98 in the authors' code), and the sum is not divided out. "plain directions": colours are looked
up along the ray as it is in posed space, beside the same with mapped directions, both composited by the benchmark from
`Deformer.to_canonical` for every second pixel of one view. A threshold of 0.98 costs nothing here because the cages
keep two cells of a 128³ lattice clear of the object; what lies nearer is lost. At 0.5 the cells at the cage show what
lies between the object and the origin, an opaque shell.
"""

#: Columns of the table of shortcuts: what each is compared with.
COSTS = {
    "nearest voxel": "frame",
    "weight sum 0.98": "frame",
    "weight sum 0.5": "frame",
    "march, plain directions": "march",
}


def own_fits(rows, middle: int) -> str:
    """Deformed fields compared with fields fitted to the pose, harmonic, at the middle resolution."""
    found = {
        (row["scene"], row["pose"], row["what"]): row
        for row in rows
        if row["kind"] == "harmonic" and row["resolution"] == middle
    }
    lines = []
    for (scene, pose, what), own in found.items():
        if what == "fit of the pose":
            frame = found[scene, pose, "frame"]
            ceiling = frame["psnr"] - frame["to_ceiling"]
            lines.append(
                [
                    scene,
                    pose,
                    f"{ceiling:.2f}",
                    f"{own['psnr']:.2f}",
                    f"{frame['psnr']:.2f}",
                    f"{frame['psnr'] - own['psnr']:+.2f}",
                ]
            )
    head = ["scene", "pose", "field at rest", "field of the pose", "deformed field", "deformed less field of the pose"]
    return table(head, lines)


def difference(row) -> str:
    return "–" if row is None else f"{row['to_ceiling']:+.2f}"


def differences(rows, middle: int, whats: list[str]) -> str:
    """Mean dB to the ceiling at the middle resolution, harmonic, one line per pose."""
    found = collections.defaultdict(list)
    for row in rows:
        if row["kind"] == "harmonic" and row["resolution"] == middle:
            found[row["pose"], row["what"]].append(row["to_ceiling"])
    lines = []
    for pose in POSES:
        values = [found.get((pose, what)) for what in whats]
        if any(values[1:]):
            lines.append([pose, *("–" if value is None else f"{sum(value) / len(value):+.2f}" for value in values)])
    return table(["pose", *("as it is" if what == "frame" else what for what in whats)], lines)


def costs(rows, middle: int) -> str:
    """dB that each shortcut costs at the middle resolution, harmonic."""
    found = {
        (row["scene"], row["pose"], row["what"]): row["psnr"]
        for row in rows
        if row["kind"] == "harmonic" and row["resolution"] == middle
    }
    lines = []
    for scene, pose in dict.fromkeys((scene, pose) for scene, pose, _ in found):
        values = [
            (found.get((scene, pose, what)), found.get((scene, pose, reference))) for what, reference in COSTS.items()
        ]
        lines.append([scene, pose, *("–" if None in pair else f"{pair[0] - pair[1]:+.2f}" for pair in values)])
    return table(["scene", "pose", *(what.removeprefix("march, ") for what in COSTS)], lines)


# First start


def first_start(files) -> list[str]:
    parts = [
        "## First start\n\nSeconds with an empty kernel cache, and with a filled one; in brackets the processor's "
        "seconds, which other work on the machine does not lengthen much.\n"
    ]
    for results in files:
        rows = [
            [row["stage"], f"{row['cold']:.2f} ({row['cold_work']:.2f})", f"{row['warm']:.2f}"]
            for row in results["rows"]
        ]
        rows.append(["added by compiling", f"{results['added']:.2f} ({results['added_work']:.2f})", ""])
        twice = ", ".join(results["compiled_twice"]) or "none"
        parts += [
            table(["stage", "cold, s", "warm, s"], rows),
            f"Limit {results['limit']:g} s; modules compiled twice in one process: {twice}; load of the machine "
            f"when it began: {results['load_average']:.1f}.\n",
            source(results),
        ]
    return parts


if __name__ == "__main__":
    main()
