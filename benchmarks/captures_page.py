"""Write the page docs/captures.md from the JSON files of capture.py.

    python benchmarks/captures_page.py --results docs/results --page docs/captures.md

Files are those of the folder whose names begin with "captures".
"""

from __future__ import annotations

import json
import pathlib

from page import page_arguments, source, table

TEXT = pathlib.Path(__file__).with_name("captures_text.md")

MEASURED = """## Measured

Every number below was written by `benchmarks/capture.py` to a JSON file in [results/](results/), with the machine and
the versions in it; this page is made from them by `python benchmarks/captures_page.py`. Found cameras are compared with
the true ones after the similarity that fits their places best: turns in degrees, places in percent of the way to the
object; and by the turns from each picture to the next and between any two, which need no alignment. Medians; in
brackets the largest. Seconds are those of the whole capture, beside them those of the processor.
"""

HEAD = [
    "scene", "pictures with a camera", "seconds (processor)", "turn, degrees", "place, %", "to the next, degrees",
    "between two, degrees", "focal length, true",
]  # fmt: skip


def row(run: dict) -> list[str]:
    return [
        run["scene"],
        f"{run['registered']} of {run['pictures']}",
        f"{run['seconds']:.0f} ({run['cpu_seconds']:.0f})",
        f"**{run['rotation_degrees']:.3f}** ({run['rotation_largest']:.2f})",
        f"**{run['place_percent']:.2f}** ({run['place_largest']:.2f})",
        f"**{run['next_degrees']:.3f}**",
        f"{run['pair_degrees']:.3f}",
        f"{run['focal_found']:.1f}, {run['focal_true']:.1f}",
    ]


def fits(run: dict) -> str:
    options = "".join(f", {name} {value:g}" for name, value in run["options"].items())
    size = "x".join(map(str, run["fitted_size"]))
    return (
        f"Fits of these pictures at {size} (quality {run['quality']}{options}, on {run['fit_device']}), every eighth "
        f"held out: **{run['psnr_found']:.2f} dB** with the cameras found, {run['psnr_true']:.2f} dB with the "
        "true ones.\n"
    )


def main() -> None:
    args = page_arguments(__doc__, "docs/captures.md")
    paths = sorted(pathlib.Path(args.results).glob("captures*.json"))
    if not paths:
        raise SystemExit(f"no captures*.json in {args.results}: run benchmarks/capture.py --json first")
    parts = [TEXT.read_text(encoding="utf-8"), MEASURED]
    for path in paths:
        results = json.loads(path.read_text(encoding="utf-8"))
        parts.append(table(HEAD, [row(run) for run in results["runs"]]))
        parts += [fits(run) for run in results["runs"] if "psnr_found" in run]
        parts.append(source(results))
    pathlib.Path(args.page).write_text("\n".join(parts), encoding="utf-8")
    print(f"{args.page}: {len(paths)} parts")


if __name__ == "__main__":
    main()
