"""Tables of the page of the paper's table and of ground truth."""

from __future__ import annotations

import collections

from pages.tables import NAMES, POSES, decibels, quality, shown, source, table

#: Columns of the table of shortcuts: what each is compared with.
COSTS = {
    "nearest voxel": "frame",
    "weight sum 0.98": "frame",
    "weight sum 0.5": "frame",
    "march, plain directions": "march",
}


def table1(files: list[dict]) -> list[str]:
    results = files[0]
    rows = []
    for row in results["rows"]:
        paper, authors = (shown(row[name], "{:g}") for name in ("paper_a100", "authors_h200"))
        psnr = "reference" if row["psnr_to_reference"] is None else f"{row['psnr_to_reference']:.1f}"
        cells = "precise" if row["resolution"] is None else f"{row['resolution']}³"
        rows.append([NAMES[row["kind"]], cells, f"**{row['seconds']:.4f}**", paper, authors, psnr])
    size, samples, voxels = results["size"], results["samples"], f"{results['voxels']:,}"
    head = ["coordinates", "lattice", "warpcage, s", "paper, s (A100)", "authors' code, s (H200)", "PSNR, dB"]
    return [
        (
            f"Scene: {results['scene']}, {voxels} voxels; {size}x{size} pixels, {samples} samples a ray across the "
            f"deformed scene's box;\ncage of {results['cage_vertices']} vertices.\n"
        ),
        table(head, rows),
        source(results),
    ]


def all_rows(files: list[dict]) -> tuple[list[dict], int]:
    """Rows of all files, and the lattice of those that compare anything but lattices."""
    return [row for results in files for row in results["rows"]], files[0]["middle"]


def ceilings(files: list[dict]) -> dict[str, dict]:
    """The scenes at rest by their names."""
    return {scene["scene"]: scene for results in files for scene in results["scenes"]}


def at_rest(files: list[dict]) -> list[str]:
    rows = [[name, f"{scene['voxels']:,}", *quality(scene), depth(scene)] for name, scene in ceilings(files).items()]
    return [table(["scene", "voxels", "PSNR, dB", "SSIM", "depth error"], rows)]


def posed(files: list[dict]) -> list[str]:
    rows, middle = all_rows(files)
    plain = [row for row in rows if row["what"] == "frame"]
    worst = min((row for row in plain if row["resolution"] == middle), key=lambda row: row["to_ceiling"])
    lattices = ["64³", "128³", "256³", "precise", f"PSNR at {middle}³"]
    head = ["scene", "pose", "coordinates", *lattices, "SSIM", "depth error", "stretch"]
    return [
        table(head, [line for name in ceilings(files) for line in posed_lines(plain, name, middle)]),
        (
            f"The farthest from the ceiling at {middle}³: {worst['to_ceiling']:+.2f} dB ({worst['scene']}, "
            f"{worst['pose']}, {NAMES[worst['kind']]}).\n"
        ),
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


def harmonic(files: list[dict]) -> dict[tuple[str, str, str], dict]:
    """The harmonic rows of the middle resolution by scene, pose and what they measure."""
    rows, middle = all_rows(files)
    chosen = (row for row in rows if row["kind"] == "harmonic" and row["resolution"] == middle)
    return {(row["scene"], row["pose"], row["what"]): row for row in chosen}


def own_fits(files: list[dict]) -> list[str]:
    """Deformed fields compared with fields fitted to the pose."""
    found = harmonic(files)
    lines = []
    for (scene, pose, what), own in found.items():
        if what == "fit of the pose":
            frame = found[scene, pose, "frame"]
            values = (frame["psnr"] - frame["to_ceiling"], own["psnr"], frame["psnr"])
            lines.append([scene, pose, *(f"{value:.2f}" for value in values), f"{frame['psnr'] - own['psnr']:+.2f}"])
    head = ["scene", "pose", "field at rest", "field of the pose", "deformed field", "deformed less field of the pose"]
    return [table(head, lines)]


def causes(files: list[dict]) -> list[str]:
    """Mean dB to the ceiling, one line per pose."""
    names = ["frame", "truth turned", "truth relit", "half step", "density paper"]
    found = collections.defaultdict(list)
    for (_, pose, what), row in harmonic(files).items():
        found[pose, what].append(row["to_ceiling"])
    lines = []
    for pose in POSES:
        values = [found.get((pose, what)) for what in names]
        if any(values[1:]):
            lines.append([pose, *(decibels(value and sum(value) / len(value)) for value in values)])
    return [table(["pose", "as it is", *names[1:]], lines)]


def shortcuts(files: list[dict]) -> list[str]:
    """dB that each shortcut costs."""
    found = {place: row["psnr"] for place, row in harmonic(files).items()}
    lines = []
    for scene, pose in dict.fromkeys((scene, pose) for scene, pose, _ in found):
        pairs = [(found.get((scene, pose, what)), found.get((scene, pose, other))) for what, other in COSTS.items()]
        lines.append([scene, pose, *(decibels(None if None in pair else pair[0] - pair[1]) for pair in pairs)])
    return [table(["scene", "pose", *(what.removeprefix("march, ") for what in COSTS)], lines)]


def coverage(files: list[dict]) -> list[str]:
    rows = [
        [row["scene"], row["pose"], f"{row['rest']:.3f}", f"{row['posed']:.3f}", f"{row['decibels']:+.2f}"]
        for row in files[0]["rows"]
    ]
    return [
        table(["scene", "pose", "covered at rest", "covered posed", "dB by coverage alone"], rows),
        source(files[0]),
    ]


def start(files: list[dict]) -> list[str]:
    parts = []
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
