"""Pages of docs, of the results that lie in docs/results: none is edited manually.

Texts are in the .md files beside this one, in pieces that follow their names.
"""

from __future__ import annotations

import importlib.util
import json
import os
import pathlib
import shlex
import tempfile
import textwrap

from common import HERE, UsageError, command, option, write_jpeg, write_results
from pages import splats, truth
from pages.tables import NAMES, by_pixels, filled, source, table, texts

RESULTS = option("--results", default="docs/results", help="folder of results (default: %(default)s)")


def page_options(page: str) -> tuple:
    """The folder of results, and the page that is made of them."""
    return RESULTS, option("--page", default=f"docs/{page}.md", help="(default: %(default)s)")


def write_page(args, parts: list[str], sections: dict, what: str) -> None:
    """Add to the parts what each section makes of the files of its pattern, and write the page."""
    begin, folder = len(parts), pathlib.Path(args.results)
    for pattern, section in sections.items():
        files = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(pattern))]
        if files:
            parts += section(files, pathlib.Path(args.page).parent / "pictures")
        else:
            print(f"no {pattern} in {folder}: section left out")
    if len(parts) == begin:
        raise SystemExit(f"no results in {folder}: run python benchmarks {what} --json first")
    pathlib.Path(args.page).write_text("\n".join(parts), encoding="utf-8")
    print(f"{args.page}: {len(parts)} parts")


@command(*page_options("results"))
def results(args) -> None:
    """Write docs/results.md from the results of `frames table1`, `truth fields`, `truth coverage` and compile.py.

        python benchmarks pages results --results docs/results --page docs/results.md

    Sections whose file is missing are left out, and named on the way.
    """
    sections = {
        "table1.json": truth.table1_parts,
        "ground_truth*.json": truth.fields_parts,
        "coverage.json": truth.coverage_parts,
        "compile*.json": truth.start_parts,
    }
    write_page(args, [texts("results")["introduction"]], sections, "frames table1")


@command(*page_options("splats_views"))
def splats_views(args) -> None:
    """Write docs/splats_views.md from the results of `splats views`, `splats poses` and `splats-truth`.

        python benchmarks pages splats-views --results docs/results --page docs/splats_views.md

    Files are those of the folder whose names begin with "splats_times", "splat_poses" and "splats_truth"; sections
    without any are left out.
    """
    sections = {
        "splats_times*.json": splats.times_parts,
        "splat_poses*.json": splats.poses_parts,
        "splats_truth*.json": splats.truth_parts,
    }
    write_page(args, [texts("splats_views")["text"]], sections, "splats-truth")


# Captures


@command(*page_options("captures"))
def captures(args) -> None:
    """Write docs/captures.md from the results of `captures`.

        python benchmarks pages captures --results docs/results --page docs/captures.md

    Files are those of the folder whose names begin with "captures".
    """
    write_page(args, list(texts("captures").values()), {"captures*.json": capture_parts}, "captures")


def capture_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
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


# Trends


@command(*page_options("trends"))
def trends(args) -> None:
    """Write docs/trends.md from the results of `by-turns`, one of each release beside the one before.

        python benchmarks pages trends --results docs/results --page docs/trends.md

    Files are those of the folder whose names begin with "trend", in the order of their names.
    """
    write_page(args, [texts("trends")["introduction"]], {"trend*.json": trend_parts}, "by-turns")


def trend_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    names = list(dict.fromkeys(row["what"] for found in files for row in found["rows"]))
    head = ["", *(f"{found['other']} to {found['this']}, {found['date']}" for found in files)]
    rows = [[name.replace(",-", ", ").replace("-", " ").replace("_", " ")] for name in names]
    for found in files:
        by_name = {row["what"]: row for row in found["rows"]}
        for name, cells in zip(names, rows, strict=True):
            row = by_name.get(name)
            cells.append(
                "–" if row is None else f"{row['other_ms']:g} to {row['this_ms']:g} ms, **{row['ratio']:.2f}**"
            )
    return [table(head, rows), *(source(found) for found in files)]


# Fits


@command(*page_options("fits"))
def fits(args) -> None:
    """Write docs/fits.md from the results of `fits scenes`.

        python benchmarks pages fits --results docs/results --page docs/fits.md

    Files are those of the folder whose names begin with "fits", in the order of their names. One may hold a "note",
    which is put below its table.
    """
    write_page(args, [texts("fits")["introduction"]], {"fits*.json": fit_parts}, "fits scenes")


@command(*page_options("fits_of_captures"))
def fits_of_captures(args) -> None:
    """Write docs/fits_of_captures.md from the results of `fits scenes` of captures, given and made.

        python benchmarks pages fits-of-captures --results docs/results --page docs/fits_of_captures.md

    Files are those of the folder whose names begin with "scenes", in the order of their names, each with its "note".
    """
    introduction = [texts("fits_of_captures")["introduction"]]
    write_page(args, introduction, {"scenes*.json": capture_fit_parts}, "fits scenes --made")


def capture_fit_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    head = ["scene", "views", "size", "quality", "PSNR, dB", "off the path", "worst views", "seconds", "million voxels",
            "GB", "frame, ms"]  # fmt: skip
    parts = []
    for found in files:
        rows = [fit_row(run) for run in found["runs"]]
        parts += [table(head, [[row[name] for name in head] for row in rows]), source(found)]
        if "note" in found:
            parts.append(found["note"] + "\n")
        if "sheet" in found:
            shown, sheet = ", ".join(found["sheet"]["fits"]), found["sheet"]["file"]
            parts.append(
                f"Row by row, rendered on the left: the worst view of {shown}.\n\n![{shown}](pictures/{sheet})\n"
            )
    return parts


def fit_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    head = ["scene", "views", "quality", "PSNR, dB", "seconds", "GB", "own views", "opacity", "million voxels",
            "worst views"]  # fmt: skip
    parts, heading = [], ""
    for found in files:
        if fits_title(found) != heading:
            heading = fits_title(found)
            parts.append(f"## {heading}\n")
        with_inside = any(run.get("psnr_inside") is not None for run in found["runs"])
        shown = [*head[:4], "object, dB", *head[4:]] if with_inside else head
        rows = [fit_row(run) for run in found["runs"]]
        parts += [table(shown, [[row[name] for name in shown] for row in rows]), source(found)]
        if "note" in found:
            parts.append(found["note"] + "\n")
    return parts


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

    opacity = "–" if run["alpha_error"] is None else f"{run['alpha_error']:.4f}"
    worst = ", ".join(f"{view} {psnr:.1f}" for psnr, view in run["worst"])
    resolution, million = by_pixels(run["resolution"]), run["voxels"] / 1e6
    quality = run["options"].get("quality", "standard")
    usual = checked_options({"quality": quality})
    changed = {name: value for name, value in run["options"].items() if name != "quality"}
    given = [f"{name}={value}" for name, value in changed.items() if value != getattr(usual, name)]
    inside, aside = run.get("psnr_inside"), run.get("psnr_aside")
    psnr = f"**{run['psnr']:.2f}**"
    if "psnr_tuned" in run:
        psnr += f"; aligned {run['psnr_aligned']:.2f}, tuned {run['psnr_tuned']:.2f}"
    return {
        "scene": run["scene"],
        "views": str(run["views"]),
        "size": str(run["size"]),
        "quality": " ".join([quality, *given]),
        "PSNR, dB": psnr,
        "off the path": "–" if aside is None else f"**{aside:.2f}**",
        "object, dB": "–" if inside is None else f"{inside:.2f}",
        "seconds": f"{run['seconds']:.1f}",
        "GB": memory(run),
        "frame, ms": "–" if run.get("frame_milliseconds") is None else f"{run['frame_milliseconds']:.1f}",
        "own views": f"{run['psnr_training']:.2f}",
        "opacity": opacity,
        "million voxels": f"{million:.{1 if million >= 0.1 else 3}f} of {resolution}",
        "worst views": worst,
    }


def memory(run: dict) -> str:
    """Gigabytes of a fit's peak: "≤" where an earlier fit, or an evaluation, reached as much in that process."""
    if run["memory"] is None:
        return "–"
    its_own = "memory_before" in run and run["memory"] > run["memory_before"]
    return f"{'' if its_own else '≤ '}{run['memory'] / 1e9:.2f}"


# Frames

#: What `frames times` calls its rows.
READY, RANDOM, FIRST, LOOP = (
    "frame, lattice ready",
    "pose and frame, random",
    "the first ten, the longest",
    "posing in a loop",
)
THREE_SLABS = "frame, three slabs, lattices ready"

#: Angle and number of poses that `frames times` takes by default.
BEND, POSE_COUNT = 45.0, 40


@command(*page_options("frames"))
def frames(args) -> None:
    """Write docs/frames.md from the results of `frames times`.

        python benchmarks pages frames --results docs/results --page docs/frames.md

    Files are those of the folder whose names begin with "frames"; those of one size are runs of the same, whose figures
    stand beside each other.
    """
    write_page(args, [texts("frames")["introduction"]], {"frames*.json": frame_parts}, "frames times")


def frame_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    text, first = texts("frames"), files[0]
    runs: dict[tuple, list[dict]] = {}
    for found in files:
        runs.setdefault(tuple(found["size"]), []).append(found)
    head = ["picture", "coordinates", "median", "95 %", "longest", "first ten", "frames a second of a swing"]
    return [
        f"{first['voxels']:,} voxels, a cage of {first['cage_vertices']} vertices.\n",
        filled(text["frames"], bend=f"{BEND:g}", resolution=first["resolution"]),
        table(["picture", "canonical", *NAMES.values(), "three slabs"], [frame_row(*each) for each in runs.items()]),
        filled(text["poses"], count=POSE_COUNT),
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


def joined(values) -> str:
    return ", ".join(values)


def all_found(run: dict, what: str, kind: str | None = None) -> list[dict]:
    return [row for row in run["rows"] if row["what"] == what and (kind is None or row["kind"] == kind)]


def found(run: dict, what: str, kind: str | None = None) -> dict:
    (row,) = all_found(run, what, kind)
    return row


# Selections

#: Options of the example, and of its small fit.
WORDS = ["--downscale", "8", "--quality", "fast", "--resolution", "96", "--no-video"]


@command(
    option("--data", metavar="DIR", help="the fox: run the example before the page is written"),
    option("--device", default=None),
    option("--words", default=" ".join(WORDS), help="options of the example (default: %(default)s)"),
    option("--json", help="where the figures of the run go"),
    option("--figures", help="folder for the pictures of the run"),
    *page_options("select"),
)
def select(args) -> None:
    """Write docs/select.md: choosing an object of a scene, with what one run of examples/edit_fox.py makes.

        python benchmarks pages select --data data/fox --json docs/results/select.json --figures docs/pictures
        python benchmarks pages select --data data/fox --json docs/results/select_full.json --figures full \\
            --device cuda:0 --words "--downscale 2 --quality standard --no-video --cage cage.obj"
        python benchmarks pages select --results docs/results --page docs/select.md

    The first runs the example at an eighth of the pictures' size (WORDS) and keeps its figures and pictures, the second
    at half their size. All write the page.
    """
    if args.data:
        if not args.json or not args.figures:
            raise UsageError("--data runs the example: say where its --json and --figures go")
        run_example(args)
    path, large = (pathlib.Path(args.results) / f"{name}.json" for name in ("select", "select_full"))
    if not path.exists():
        raise SystemExit(f"no {path}: give --data, --json and --figures first")
    small, full = (json.loads(each.read_text(encoding="utf-8")) if each.exists() else None for each in (path, large))
    text = texts("select")
    more = ""
    if full is not None:
        said = " ".join(filled(text["full"], **select_facts(full)).split())
        more = f"\n{textwrap.fill(said, 120)}\n\n{source(full).strip()}\n"
    page = filled(text["text"], source=source(small).strip(), full=more, **select_facts(small))
    pathlib.Path(args.page).write_text(page, encoding="utf-8")
    print(f"wrote {args.page}")


def select_facts(found: dict) -> dict:
    """The figures of a run as the page names them."""
    return {
        "words": " ".join(word for word in found["words"] if word != "--no-video"),
        "size": by_pixels(found["image_size"]),
        "views": found["train_views"],
        "voxels": f"{found['voxels'] / 1e6:.1f}",
        "psnr": f"{found['psnr']:.1f}",
        "seconds": f"{found['seconds']:.0f}",
        "choosing": f"{found['choosing_seconds']:.1f}",
        "vertices": found["cage_vertices"],
        "enclosed": f"{100 * found['enclosed']:.1f}",
        "still": f"{found['still']:.1g}",
    }


def run_example(args) -> None:
    """The figures and pictures of the example."""
    from warpcage.core import resolve_device
    from warpcage.view import read_image

    arguments = shlex.split(args.words)
    spec = importlib.util.spec_from_file_location("edit_fox", HERE.parent / "examples" / "edit_fox.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    device = resolve_device(args.device)
    with tempfile.TemporaryDirectory() as out:
        figures = example.main(["--data", args.data, "--out", out, "--device", str(device), *arguments])
        for name in ("chosen", "edit"):
            picture = read_image(pathlib.Path(out) / f"{name}.png")
            write_jpeg(pathlib.Path(args.figures) / f"select_{name}.jpg", picture[..., :3], quality=90)
    del figures["device"]  # the machine's is written
    arguments = [os.path.basename(each) if os.path.isabs(each) else each for each in arguments]
    write_results(args.json, device, words=arguments, **figures)


# Batches


def batch_scale_text(items: int, workers: int, aim: float, largest: int, content: dict) -> str:
    """The page of `batch-scale`, from its results and how chunks are cut."""
    costs, ends = content["costs"], content["driver"]
    alone, full = 1.0 / (costs["lot"] + costs["item"]), largest / (costs["lot"] + largest * costs["item"])
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
        for run in content["simulated"]
    ]
    ends = {name: f"{value:.0f}" for name, value in ends.items()} | {"planned": f"{ends['items']:,}"}
    return filled(
        texts("batch_scale")["text"],
        **ends
        | {
            "aim": f"{aim:.0f}",
            "largest": largest,
            "chunk": f"{1e3 * costs['lot']:.2f}",
            "item": f"{1e3 * costs['item']:.4f}",
            "alone": f"{alone:,.0f}",
            "full": f"{full:,.0f}",
            "busy_full": f"{1000 / full:.3f}",
            "busy_alone": f"{1000 / alone:.2f}",
            "items": f"{items:,}",
            "workers": f"{workers:,}",
            "table": table(head, rows).rstrip(),
        },
    )
