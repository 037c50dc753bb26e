"""Write the page docs/fits.md from the JSON files of fit_scenes.py.

    python benchmarks/fits_page.py --results docs/results --page docs/fits.md

Files are those of the folder whose names begin with "fits", in the order of their names. One may hold a "note", which
is put below its table.
"""

from __future__ import annotations

import json
import pathlib

from page import page_arguments, source, table

from warpcage.fitting.options import checked_options

INTRODUCTION = """# Measured: fits of several scenes

Every number on this page was written by `benchmarks/fit_scenes.py` to a JSON file in [results/](results/), with the
machine and the versions in it; the page is made from them by `python benchmarks/fits_page.py`. Fits have a quality and
nothing else: options that a command gives, but the table does not name, are those of the quality today. Seconds run
from pictures in host memory to the finished field, kernels compiled before. PSNR is the mean over views that the fit
has not seen; beside it stand that of the object's pixels, where they are told apart, that of its own views, the mean
error of opacity where pictures have alpha, and the worst views. Memory is the most that the arrays of a fit, pictures
included, held on the GPU until it ended; the driver counts the most since the process began, so that a fit that stays
below one before it, or below an evaluation between them, has "≤". Where cameras were refined, the held-out views are
also compared by cameras moved along with the refined ones ("aligned") and by cameras fitted to the field ("tuned").
What was tried, with outcomes, is in [the notes](../benchmarks/NOTES-fit.md) and [those on
backgrounds](../benchmarks/NOTES-background.md).
"""


def title(results: dict) -> str:
    parts = []
    if results["pose_noise"]:
        parts.append(f"cameras turned by {results['pose_noise']:g} degrees")
    if results["jpeg"]:
        parts.append(f"pictures through JPEG of quality {results['jpeg']}")
    return " and ".join(parts).capitalize() if parts else "As they are"


def run_row(run: dict, with_inside: bool) -> list[str]:
    opacity = "–" if run["alpha_error"] is None else f"{run['alpha_error']:.4f}"
    worst = ", ".join(f"{view} {psnr:.1f}" for psnr, view in run["worst"])
    resolution = "x".join(map(str, run["resolution"]))
    quality = run["options"].get("quality", "standard")
    usual = checked_options({"quality": quality})
    changed = {name: value for name, value in run["options"].items() if name != "quality"}
    given = [f"{name}={value}" for name, value in changed.items() if value != getattr(usual, name)]
    inside = run.get("psnr_inside")
    psnr = f"**{run['psnr']:.2f}**"
    if "psnr_tuned" in run:
        psnr += f"; aligned {run['psnr_aligned']:.2f}, tuned {run['psnr_tuned']:.2f}"
    of_object = ["–" if inside is None else f"{inside:.2f}"] if with_inside else []
    return [
        run["scene"],
        str(run["views"]),
        " ".join([quality, *given]),
        psnr,
        *of_object,
        f"{run['seconds']:.1f}",
        memory(run),
        f"{run['psnr_training']:.2f}",
        opacity,
        f"{run['voxels'] / 1e6:.1f} of {resolution}",
        worst,
    ]


def memory(run: dict) -> str:
    """Gigabytes of a fit's peak: "≤" where an earlier fit, or an evaluation, reached as much in that process."""
    if run["memory"] is None:
        return "–"
    its_own = "memory_before" in run and run["memory"] > run["memory_before"]
    return f"{'' if its_own else '≤ '}{run['memory'] / 1e9:.2f}"


HEAD = [
    "scene", "views", "quality", "PSNR, dB", "seconds", "GB", "own views", "opacity", "million voxels", "worst views",
]  # fmt: skip


def main() -> None:
    args = page_arguments(__doc__, "docs/fits.md")
    paths = sorted(pathlib.Path(args.results).glob("fits*.json"))
    if not paths:
        raise SystemExit(f"no fits*.json in {args.results}: run benchmarks/fit_scenes.py --json first")
    parts, heading = [INTRODUCTION], ""
    for path in paths:
        results = json.loads(path.read_text(encoding="utf-8"))
        if title(results) != heading:
            heading = title(results)
            parts.append(f"## {heading}\n")
        with_inside = any(run.get("psnr_inside") is not None for run in results["runs"])
        head = [*HEAD[:4], "object, dB", *HEAD[4:]] if with_inside else HEAD
        parts += [table(head, [run_row(run, with_inside) for run in results["runs"]]), source(results)]
        if "note" in results:
            parts.append(results["note"] + "\n")
    pathlib.Path(args.page).write_text("\n".join(parts), encoding="utf-8")
    print(f"{args.page}: {len(paths)} parts")


if __name__ == "__main__":
    main()
