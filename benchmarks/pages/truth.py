"""Tables of the page of the paper's table and of ground truth."""

from __future__ import annotations

import collections
import pathlib

from pages.tables import NAMES, POSES, decibels, filled, quality, source, table, texts

TEXTS = texts("results")

#: Columns of the table of shortcuts: what each is compared with.
COSTS = {
    "nearest voxel": "frame",
    "weight sum 0.98": "frame",
    "weight sum 0.5": "frame",
    "march, plain directions": "march",
}


def table1_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    results = files[0]
    rows = []
    for row in results["rows"]:
        paper, authors = ("–" if row[name] is None else f"{row[name]:g}" for name in ("paper_a100", "authors_h200"))
        psnr = "reference" if row["psnr_to_reference"] is None else f"{row['psnr_to_reference']:.1f}"
        cells = "precise" if row["resolution"] is None else f"{row['resolution']}³"
        rows.append([NAMES[row["kind"]], cells, f"**{row['seconds']:.4f}**", paper, authors, psnr])
    facts = {name: results[name] for name in ("scene", "size", "samples")}
    facts |= {"voxels": f"{results['voxels']:,}", "vertices": results["cage_vertices"]}
    head = ["coordinates", "lattice", "warpcage, s", "paper, s (A100)", "authors' code, s (H200)", "PSNR, dB"]
    return [
        filled(TEXTS["table1"], reference=results["harmonic_reference"], **facts),
        table(head, rows),
        source(results),
        TEXTS["table1 figure"],
    ]


def fields_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    rows = [row for results in files for row in results["rows"]]
    middle = files[0]["middle"]
    ceilings = {scene["scene"]: scene for results in files for scene in results["scenes"]}
    plain = [row for row in rows if row["what"] == "frame"]
    rests = [[name, f"{scene['voxels']:,}", *quality(scene), depth(scene)] for name, scene in ceilings.items()]
    worst = min((row for row in plain if row["resolution"] == middle), key=lambda row: row["to_ceiling"])
    said = f"{worst['to_ceiling']:+.2f} dB ({worst['scene']}, {worst['pose']}, {NAMES[worst['kind']]})"
    lattices = ["64³", "128³", "256³", "precise", f"PSNR at {middle}³"]
    pictures_of = "rest, truth, deformed field, five times the difference"
    return [
        TEXTS["truth"],
        TEXTS["rest"],
        table(["scene", "voxels", "PSNR, dB", "SSIM", "depth error"], rests),
        TEXTS["posed"],
        table(
            ["scene", "pose", "coordinates", *lattices, "SSIM", "depth error", "stretch"],
            [line for name in ceilings for line in posed_lines(plain, name, middle)],
        ),
        filled(TEXTS["farthest"], middle=middle, worst=said),
        *[source(results) for results in files],
        "\n".join(f"![{name}: {pictures_of}](pictures/ground_truth_{name}.jpg)\n" for name in ceilings),
        filled(TEXTS["figures"], middle=middle),
        TEXTS["own fits"],
        own_fits(rows, middle),
        TEXTS["causes"],
        differences(rows, middle, ["frame", "truth turned", "truth relit", "half step", "density paper"]),
        TEXTS["shortcuts"],
        costs(rows, middle),
    ]


def depth(measured: dict) -> str:
    return f"{1e3 * measured['depth_mean']:.1f} ‰"


def posed_lines(plain: list[dict], scene: str, middle: int) -> list[list[str]]:
    """Lines of one scene, for each pose and kind of coordinates."""
    lines = []
    for pose in POSES:
        for kind, name in NAMES.items():
            wanted = (scene, pose, kind)
            found = {row["resolution"]: row for row in plain if (row["scene"], row["pose"], row["kind"]) == wanted}
            if found:
                at = found[middle]
                away = (found[r]["to_ceiling"] if r in found else None for r in (64, 128, 256, None))
                stretch = "{:.2f}–{:.2f}".format(*at["stretch"])
                lines.append([scene, pose, name, *map(decibels, away), *quality(at), depth(at), stretch])
    return lines


def harmonic(rows: list[dict], middle: int) -> dict[tuple[str, str, str], dict]:
    """The harmonic rows of one resolution by scene, pose and what they measure."""
    chosen = (row for row in rows if row["kind"] == "harmonic" and row["resolution"] == middle)
    return {(row["scene"], row["pose"], row["what"]): row for row in chosen}


def own_fits(rows: list[dict], middle: int) -> str:
    """Deformed fields compared with fields fitted to the pose, harmonic, at the middle resolution."""
    found = harmonic(rows, middle)
    lines = []
    for (scene, pose, what), own in found.items():
        if what == "fit of the pose":
            frame = found[scene, pose, "frame"]
            values = (frame["psnr"] - frame["to_ceiling"], own["psnr"], frame["psnr"])
            lines.append([scene, pose, *(f"{value:.2f}" for value in values), f"{frame['psnr'] - own['psnr']:+.2f}"])
    head = ["scene", "pose", "field at rest", "field of the pose", "deformed field", "deformed less field of the pose"]
    return table(head, lines)


def differences(rows: list[dict], middle: int, whats: list[str]) -> str:
    """Mean dB to the ceiling at the middle resolution, harmonic, one line per pose."""
    found = collections.defaultdict(list)
    for (_, pose, what), row in harmonic(rows, middle).items():
        found[pose, what].append(row["to_ceiling"])
    lines = []
    for pose in POSES:
        values = [found.get((pose, what)) for what in whats]
        if any(values[1:]):
            lines.append([pose, *(decibels(value and sum(value) / len(value)) for value in values)])
    return table(["pose", *("as it is" if what == "frame" else what for what in whats)], lines)


def costs(rows: list[dict], middle: int) -> str:
    """dB that each shortcut costs at the middle resolution, harmonic."""
    found = {place: row["psnr"] for place, row in harmonic(rows, middle).items()}
    lines = []
    for scene, pose in dict.fromkeys((scene, pose) for scene, pose, _ in found):
        pairs = [(found.get((scene, pose, what)), found.get((scene, pose, other))) for what, other in COSTS.items()]
        lines.append([scene, pose, *(decibels(None if None in pair else pair[0] - pair[1]) for pair in pairs)])
    return table(["scene", "pose", *(what.removeprefix("march, ") for what in COSTS)], lines)


def coverage_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    results = files[0]
    rows = [
        [row["scene"], row["pose"], f"{row['rest']:.3f}", f"{row['posed']:.3f}", f"{row['decibels']:+.2f}"]
        for row in results["rows"]
    ]
    head = ["scene", "pose", "covered at rest", "covered posed", "dB by coverage alone"]
    return [TEXTS["coverage"], table(head, rows), source(results)]


def start_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    parts = [TEXTS["first start"]]
    for results in files:
        rows = [
            [row["stage"], f"{row['cold']:.2f} ({row['cold_work']:.2f})", f"{row['warm']:.2f}"]
            for row in results["rows"]
        ]
        rows.append(["added by compiling", f"{results['added']:.2f} ({results['added_work']:.2f})", ""])
        twice = ", ".join(results["compiled_twice"]) or "none"
        parts += [
            table(["stage", "cold, s", "warm, s"], rows),
            (
                f"Limit {results['limit']:g} s; modules compiled twice in one process: {twice}; load of the machine "
                f"when it began: {results['load_average']:.1f}.\n"
            ),
            source(results),
        ]
    return parts
