"""Write the page docs/frames.md from the JSON files of deformed_render.py.

    python benchmarks/frames_page.py --results docs/results --page docs/frames.md

Files are those of the folder whose names begin with "frames"; those of one size are runs of the same, whose figures
stand beside each other.
"""

from __future__ import annotations

import json
import pathlib

from page import KINDS, page_arguments, source, table

INTRODUCTION = """# Frames and poses

Every number on this page was measured by `benchmarks/deformed_render.py` and lies in a JSON file in
[results/](results/), with the machine and the versions; the page is made from them by
`python benchmarks/frames_page.py`. Cells hold a figure of each run. What was tried is in
[NOTES-render](../benchmarks/NOTES-render.md).
"""

FRAMES = """## Frames

Milliseconds of a frame whose pose is ready, medians; in brackets how many times a canonical frame that is, in the same
seconds: the cage bent by {bend:g} degrees, its map on a lattice of {resolution} cells. Slabs are boxes beside each
other, each turned: three, and in brackets how many times one they take.
"""

POSES = """## Poses

Milliseconds of a new pose and its frame, nothing at work before and after: {count} random smooth poses, each another
one, their median, 95th percentile and longest; the longest of the first ten poses of a new Deformer; and frames a
second of a swing, each frame of which is a new pose. A longest one far above the rest waited for
what the notes say of it.
"""

#: What deformed_render.py calls its rows.
READY, RANDOM, FIRST, LOOP = (
    "frame, lattice ready",
    "pose and frame, random",
    "the first ten, the longest",
    "posing in a loop",
)
THREE_SLABS = "frame, three slabs, lattices ready"

#: Angle and number of poses that deformed_render.py takes unless it is told another.
BEND, POSE_COUNT = 45.0, 40


def main() -> None:
    args = page_arguments(__doc__, "docs/frames.md")
    paths = sorted(pathlib.Path(args.results).glob("frames*.json"))
    files = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    if not files:
        raise SystemExit(f"no results in {args.results}: run benchmarks/deformed_render.py --json first")
    runs: dict[tuple, list[dict]] = {}
    for results in files:
        runs.setdefault(tuple(results["size"]), []).append(results)
    first = files[0]
    what = f"{first['voxels']:,} voxels, a cage of {first['cage_vertices']} vertices.\n"
    parts = [INTRODUCTION, what, FRAMES.format(bend=BEND, resolution=first["resolution"])]
    head = ["picture", "canonical", *KINDS.values(), "three slabs"]
    parts.append(table(head, [frame_row(*each) for each in runs.items()]))
    parts.append(POSES.format(count=POSE_COUNT))
    head = ["picture", "coordinates", "median", "95 %", "longest", "first ten", "frames a second of a swing"]
    parts.append(table(head, [pose_row(size, kind, each) for size, each in runs.items() for kind in KINDS]))
    parts += [f"{len(each)} runs:\n{source(each[-1])}" for each in runs.values()]
    pathlib.Path(args.page).write_text("\n".join(parts), encoding="utf-8")
    print(f"{args.page}: {len(files)} runs")


def frame_row(size: tuple, runs: list[dict]) -> list[str]:
    canonical = joined(f"{found(run, 'canonical frame')['milliseconds']:.2f}" for run in runs)
    bends = [joined(with_times(found(run, READY, kind), "times_canonical") for run in runs) for kind in KINDS]
    slabs = joined(with_times(found(run, THREE_SLABS), "times_one") for run in runs)
    return [name_of(size), canonical, *bends, slabs]


def pose_row(size: tuple, kind: str, runs: list[dict]) -> list[str]:
    rows = [found(run, RANDOM, kind) for run in runs]
    names = ("milliseconds", "percentile_95", "longest")
    times = [joined(f"{row[name]:.1f}" for row in rows) for name in names]
    firsts = joined(f"{found(run, FIRST, kind)['milliseconds']:.1f}" for run in runs)
    swing = joined(f"{row['frames_a_second']:.0f}" for run in runs for row in all_found(run, LOOP, kind))
    return [name_of(size), KINDS[kind], *times, firsts, swing or "–"]


def name_of(size: tuple) -> str:
    return "x".join(map(str, size))


def with_times(row: dict, name: str) -> str:
    return f"{row['milliseconds']:.2f} ({row[name]:.2f})"


def joined(values) -> str:
    return ", ".join(values)


def all_found(run: dict, what: str, kind: str | None = None) -> list[dict]:
    return [row for row in run["rows"] if row["what"] == what and (kind is None or row["kind"] == kind)]


def found(run: dict, what: str, kind: str | None = None) -> dict:
    (row,) = all_found(run, what, kind)
    return row


if __name__ == "__main__":
    main()
