"""Tables of docs pages, made of the results in docs/results.

A page of docs holds its own text. Between `<!-- made: NAME -->` and `<!-- end -->` stands what a function here makes of
the files that PAGES names.
"""

from __future__ import annotations

import json
import pathlib
import re

from common import HERE, command, option
from pages import splats, truth
from pages.tables import NAMES, by_pixels, joined, shown, source, table, with_sources

BLOCK = re.compile(r"<!-- made: (.*?) -->\n.*?<!-- end -->", re.DOTALL)


def captures(files: list[dict]) -> list[str]:
    head = ["scene", "pictures with a camera", "seconds (processor)", "turn, degrees", "place, %",
            "to the next, degrees", "between two, degrees", "focal length, true"]  # fmt: skip
    parts = []
    for found in files:
        parts.append(table(head, [capture_row(run) for run in found["runs"]]))
        parts += [compared_fits(run) for run in found["runs"] if "psnr_found" in run]
        parts.append(source(found))
    return parts


def capture_row(run: dict) -> list[str]:
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


def compared_fits(run: dict) -> str:
    options = "".join(f", {name} {value:g}" for name, value in run["options"].items())
    size = by_pixels(run["fitted_size"])
    return (
        f"Fits of these pictures at {size} (quality {run['quality']}{options}, on {run['fit_device']}), every eighth "
        f"held out: **{run['psnr_found']:.2f} dB** with the cameras found, {run['psnr_true']:.2f} dB with the "
        "true ones.\n"
    )


def trends(files: list[dict]) -> list[str]:
    names = dict.fromkeys(row["what"] for found in files for row in found["rows"])
    by_name = [{row["what"]: row for row in found["rows"]} for found in files]
    head = ["", *(f"{found['other']} to {found['this']}, {found['date']}" for found in files)]
    rows = [
        [name.replace(",-", ", ").replace("-", " ").replace("_", " "), *(trend(rows.get(name)) for rows in by_name)]
        for name in names
    ]
    return [table(head, rows), *map(source, files)]


def trend(row: dict | None) -> str:
    return "–" if row is None else f"{row['other_ms']:g} to {row['this_ms']:g} ms, **{row['ratio']:.2f}**"


# Fits


def fits_of_captures(files: list[dict]) -> list[str]:
    head = ["scene", "views", "size", "quality", "PSNR, dB", "off the path", "worst views", "seconds", "million voxels",
            "GB", "frame, ms"]  # fmt: skip
    parts = []
    for found in files:
        parts += fit_table(found, head)
        if "sheet" in found:
            fits, sheet = ", ".join(found["sheet"]["fits"]), found["sheet"]["file"]
            parts.append(
                f"Row by row, rendered on the left: the worst view of {fits}.\n\n![{fits}](pictures/{sheet})\n"
            )
    return parts


def fits(files: list[dict]) -> list[str]:
    head = ["scene", "views", "quality", "PSNR, dB", "object, dB", "seconds", "GB", "own views", "opacity",
            "million voxels", "worst views"]  # fmt: skip
    parts, heading = [], ""
    for found in files:
        if fits_title(found) != heading:
            heading = fits_title(found)
            parts.append(f"## {heading}\n")
        with_object = any(run.get("psnr_inside") is not None for run in found["runs"])
        parts += fit_table(found, [name for name in head if with_object or name != "object, dB"])
    return parts


def fit_table(found: dict, head: list[str]) -> list[str]:
    rows = [fit_row(run) for run in found["runs"]]
    note = [found["note"] + "\n"] if "note" in found else []
    return [table(head, [[row[name] for name in head] for row in rows]), source(found), *note]


def fits_title(results: dict) -> str:
    parts = []
    if results["pose_noise"]:
        parts.append(f"cameras turned by {results['pose_noise']:g} degrees")
    if results["jpeg"]:
        parts.append(f"pictures through JPEG of quality {results['jpeg']}")
    return " and ".join(parts).capitalize() if parts else "As they are"


def fit_row(run: dict) -> dict[str, str]:
    """What a fit reached by the heads of columns."""
    from warpcage.fitting import checked_options

    million, quality = run["voxels"] / 1e6, run["options"].get("quality", "standard")
    defaults = checked_options({"quality": quality})
    changed = {name: value for name, value in run["options"].items() if name != "quality"}
    given = [f"{name}={value}" for name, value in changed.items() if value != getattr(defaults, name)]
    psnr = f"**{run['psnr']:.2f}**"
    if "psnr_tuned" in run:
        psnr += f"; aligned {run['psnr_aligned']:.2f}, tuned {run['psnr_tuned']:.2f}"
    return {
        "scene": run["scene"],
        "views": str(run["views"]),
        "size": str(run["size"]),
        "quality": " ".join([quality, *given]),
        "PSNR, dB": psnr,
        "off the path": shown(run.get("psnr_aside"), "**{:.2f}**"),
        "object, dB": shown(run.get("psnr_inside"), "{:.2f}"),
        "seconds": f"{run['seconds']:.1f}",
        "GB": memory(run),
        "frame, ms": shown(run.get("frame_milliseconds"), "{:.1f}"),
        "own views": f"{run['psnr_training']:.2f}",
        "opacity": shown(run["alpha_error"], "{:.4f}"),
        "million voxels": f"{million:.{1 if million >= 0.1 else 3}f} of {by_pixels(run['resolution'])}",
        "worst views": ", ".join(f"{view} {psnr:.1f}" for psnr, view in run["worst"]),
    }


def memory(run: dict) -> str:
    """Gigabytes of a fit's peak: "≤" where an earlier fit, or an evaluation, reached as much in that process."""
    if run["memory"] is None:
        return "–"
    its_own = "memory_before" in run and run["memory"] > run["memory_before"]
    return f"{'' if its_own else '≤ '}{run['memory'] / 1e9:.2f}"


# Frames

#: Rows of `frames times`.
READY, RANDOM, FIRST, LOOP = (
    "frame, lattice ready",
    "pose and frame, random",
    "the first ten, the longest",
    "posing in a loop",
)
THREE_SLABS = "frame, three slabs, lattices ready"


def by_size(files: list[dict]) -> dict[tuple, list[dict]]:
    """Runs of one size, whose figures stand beside each other."""
    runs: dict[tuple, list[dict]] = {}
    for found in files:
        runs.setdefault(tuple(found["size"]), []).append(found)
    return runs


def frames(files: list[dict]) -> list[str]:
    head = ["picture", "canonical", *NAMES.values(), "three slabs"]
    return [table(head, [frame_row(*each) for each in by_size(files).items()])]


def poses(files: list[dict]) -> list[str]:
    head = ["picture", "coordinates", "median", "95 %", "longest", "first ten", "frames a second of a swing"]
    runs = by_size(files)
    return [
        table(head, [pose_row(size, kind, each) for size, each in runs.items() for kind in NAMES]),
        *(f"{len(each)} runs:\n{source(each[-1])}" for each in runs.values()),
    ]


def frame_row(size: tuple, runs: list[dict]) -> list[str]:
    canonical = joined(f"{found(run, 'canonical frame')['milliseconds']:.2f}" for run in runs)
    bends = [joined(with_times(found(run, READY, kind), "times_canonical") for run in runs) for kind in NAMES]
    slabs = joined(with_times(found(run, THREE_SLABS), "times_one") for run in runs)
    return [by_pixels(size), canonical, *bends, slabs]


def pose_row(size: tuple, kind: str, runs: list[dict]) -> list[str]:
    rows = [found(run, RANDOM, kind) for run in runs]
    names = ("milliseconds", "percentile_95", "longest")
    times = [joined(f"{row[name]:.1f}" for row in rows) for name in names]
    firsts = joined(f"{found(run, FIRST, kind)['milliseconds']:.1f}" for run in runs)
    swing = joined(f"{row['frames_a_second']:.0f}" for run in runs for row in all_found(run, LOOP, kind))
    return [by_pixels(size), NAMES[kind], *times, firsts, swing or "–"]


def with_times(row: dict, name: str) -> str:
    return f"{row['milliseconds']:.2f} ({row[name]:.2f})"


def all_found(run: dict, what: str, kind: str | None = None) -> list[dict]:
    return [row for row in run["rows"] if row["what"] == what and (kind is None or row["kind"] == kind)]


def found(run: dict, what: str, kind: str | None = None) -> dict:
    (row,) = all_found(run, what, kind)
    return row


# Selections and batches


def select(files: list[dict]) -> list[str]:
    head = ["options", "pictures", "million voxels", "PSNR, dB", "fit, s", "choosing, s", "cage, vertices",
            "of the fox in the cage, %", "change outside"]  # fmt: skip
    rows = [
        [
            f"`{' '.join(each for each in run['options'] if each != '--no-video')}`",
            f"{run['train_views']} of {by_pixels(run['image_size'])}",
            f"{run['voxels'] / 1e6:.1f}",
            f"{run['psnr']:.1f}",
            f"{run['seconds']:.0f}",
            f"{run['choosing_seconds']:.1f}",
            str(run["cage_vertices"]),
            f"{100 * run['enclosed']:.1f}",
            f"{run['still']:.1g}",
        ]
        for run in files
    ]
    return [table(head, rows), *map(source, files)]


def driver_costs(files: list[dict]) -> list[str]:
    from warpcage.studio.jobs import LARGEST

    chunk, item, ends = files[0]["costs"]["lot"], files[0]["costs"]["item"], files[0]["driver"]
    alone, full = 1.0 / (chunk + item), LARGEST / (chunk + LARGEST * item)
    rows = [
        ["processor time of a chunk; of each of its items more", f"{1e3 * chunk:.2f} ms; {1e3 * item:.4f} ms"],
        [f"items a second, one by one; in chunks of {LARGEST}", f"{alone:,.0f}; {full:,.0f}"],
        ["shortest items that keep 1,000 workers busy, likewise", f"{1e3 / alone:.2f} s; {1e3 / full:.3f} s"],
        [
            f"reading a job file of {ends['items']:,} items",
            f"{ends['plan_seconds']:.0f} s, {ends['plan_megabytes']:.0f} MB",
        ],
        [
            f"merging the notes, for a manifest of {ends['manifest_megabytes']:.0f} MB",
            f"{ends['merge_seconds']:.0f} s, {ends['merge_megabytes']:.0f} MB",
        ],
    ]
    return [table(["of the driver", "measured"], rows)]


def simulated(files: list[dict]) -> list[str]:
    head = ["an item takes", "chunks", "the run takes", "over ideal", "driver at work", "chunks in all", "deaths"]
    rows = [
        [
            f"{run['mean_seconds']:g} s",
            run["policy"],
            f"{run['hours']:.2f} h",
            f"{run['over_ideal']:.2f}",
            f"{100 * run['driver_busy']:.0f} %",
            f"{run['lots']:,}",
            str(run["deaths"]),
        ]
        for run in files[0]["simulated"]
    ]
    return [table(head, rows)]


# Blender


def blender_quads(files: list[dict]) -> list[str]:
    head = ["cage", "quads", "corners off the plane of their face", "points", "apart: median, 95 %, most", "quads cut"]
    rows = [
        [
            row["cage"],
            str(row["quads"]),
            f"{100 * row['planarity_posed']:.0f} % of the face at most",
            f"{row['points']:,}",
            *(", ".join(f"{share:.1e}" for share in row[key]) for key in ("quads_apart", "cut_apart")),
        ]
        for found in files
        for row in found["rows"]
    ]
    return [table(head, rows), *(f"Blender {found['blender']}: {source(found)}" for found in files)]


def blender_files(files: list[dict]) -> list[str]:
    head = ["exported as", "quads kept", "order of vertices kept", "taken as a pose"]
    rows = [
        [row["way"], *("yes" if row[key] else "**no**" for key in ("quads", "order", "fits"))]
        for found in files
        for row in found["rows"]
    ]
    return [table(head, rows), *(f"Blender {found['blender']}: {source(found)}" for found in files)]


# Poses from pictures


def poses_known(files: list[dict]) -> list[str]:
    head = ["scene", "pose", "what is known", "rms at the start", "rms found", "largest", "seconds"]
    rows = [
        [
            row["scene"] + (", splats" if found["representation"] == "splats" else ""),
            row["pose"],
            row["case"],
            f"{row['start']:.1%}",
            f"**{row['rms']:.2%}**",
            f"{row['worst']:.2%}",
        ]
        + [f"{row['seconds']:.1f}"]
        for found in files
        for row in found["rows"]
    ]
    of_size = f"Pictures of {files[0]['size']}x{files[0]['size']} pixels, {NAMES[files[0]['kind']]} coordinates.\n"
    return [of_size, table(head, rows)]


# Pages

#: Of each page: names of its blocks, the files that each is made of, and by what.
PAGES = {
    "results": {
        "table": ("table1.json", truth.table1),
        "rest": ("ground_truth*.json", truth.at_rest),
        "posed": ("ground_truth*.json", with_sources(truth.posed)),
        "own fits": ("ground_truth*.json", truth.own_fits),
        "causes": ("ground_truth*.json", truth.causes),
        "shortcuts": ("ground_truth*.json", truth.shortcuts),
        "coverage": ("coverage.json", truth.coverage),
        "start": ("compile*.json", truth.start),
    },
    "splats-views": {
        "times": ("splats_times*.json", splats.times),
        "poses": ("splat_poses*.json", splats.poses),
        "rest": ("splats_truth*.json", splats.at_rest),
        "forward": ("splats_truth*.json", splats.forward),
        "light": ("splats_truth*.json", splats.light),
        "backward": ("splats_truth*.json", splats.backward),
        "sources": ("splats_truth*.json", lambda files: dict.fromkeys(map(source, files))),
    },
    "blender": {
        "quads": ("blender_quads*.json", blender_quads),
        "files of quads": ("blender_files.json", blender_files),
    },
    "captures": {"captures": ("captures*.json", captures)},
    "trends": {"trends": ("trend*.json", trends)},
    "fit-pose": {"known": ("poses_known*.json", with_sources(poses_known))},
    "fits": {"fits": ("fits*.json", fits)},
    "fits-of-captures": {"fits": ("scenes*.json", fits_of_captures)},
    "frames": {"frames": ("frames*.json", frames), "poses": ("frames*.json", poses)},
    "select": {"runs": ("select*.json", select)},
    "batch-scale": {"costs": ("batch_scale.json", driver_costs), "simulated": ("batch_scale.json", simulated)},
}


@command(
    option("name", choices=sorted(PAGES), metavar="PAGE", help="one of: %(choices)s"),
    option("--results", default="docs/results", type=pathlib.Path, help="folder of results (default: %(default)s)"),
    option("--page", type=pathlib.Path, help="file to write (default: the page of docs)"),
)
def main(args) -> None:
    """Renew the tables of a page of docs from the results in a folder.

        python benchmarks pages fits
        python benchmarks pages results --results out --page out/results.md

    Each table is made of the files whose names begin alike, in the order of their names; tables without any files stay
    as they are. Text is edited in the page itself.
    """
    docs, blocks = HERE.parent / "docs" / f"{args.name.replace('-', '_')}.md", PAGES[args.name]

    def renewed(match: re.Match) -> str:
        pattern, make = blocks[match[1]]
        files = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(args.results.glob(pattern))]
        if not files:
            print(f"no {pattern} in {args.results}: {match[1]} left out")
            return match[0]
        return "\n\n".join([f"<!-- made: {match[1]} -->", "\n".join(make(files)).strip(), "<!-- end -->"])

    text, count = BLOCK.subn(renewed, docs.read_text(encoding="utf-8"))
    assert count == len(blocks), f"{docs} has {count} of {len(blocks)} tables"
    (args.page or docs).write_text(text, encoding="utf-8")
