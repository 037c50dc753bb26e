"""Tables of the page of splats: times, poses, ground truth."""

from __future__ import annotations

from pages.tables import NAMES, POSES, decibels, quality, source, table, with_95

#: What a Deformer leaves out in each of these rows.
SHORTCUTS = ("no turn", "no split", "full opacity", "GSDeformer")

#: What is timed of a pose.
POSE_TIMES = ("pose", "without_check", "centres_and_jacobians")


def times(files: list[dict]) -> list[str]:
    parts = []
    for results in files:
        rows = results["rows"]
        head = ["splats", "picture", "processor time, ms" if "processor_ms" in rows[0] else "ms (95 %)"]
        with_peer = any("gsplat_ms" in row for row in rows)
        head += ["gsplat, ms (95 %)", "gsplat / warpcage", "PSNR to gsplat, dB"] if with_peer else []
        parts += [table(head, [time_row(row, with_peer) for row in rows]), source(results)]
    return parts


def time_row(row: dict, with_peer: bool) -> list[str]:
    degree = f"of degree {row['degree']}" if row["degree"] else "without harmonics"
    antialiased = ", antialiased" if row["antialias"] else ""
    took = f"{row['processor_ms']:.0f}" if "processor_ms" in row else with_95(*row["ms"])
    cells = [f"{row['splats']:,} {degree}{antialiased}", f"{row['size']}x{row['size']}", took]
    if with_peer:
        ratio, agreement = f"{row['gsplat_over_ours']:.2f}", f"{row['psnr_to_gsplat']:.1f}"
        cells += [with_95(*row["gsplat_ms"]), ratio, agreement]
    return cells


def poses(files: list[dict]) -> list[str]:
    head = ["coordinates", "splats", "sums", "whole pose, ms (95 %)", "without check", "centres and Jacobians"]
    parts = []
    for results in files:
        shape = f"{results['splats']:,} splats of degree 3 in a cage of {results['cage_vertices']} vertices:\n"
        parts += [shape, table(head, [pose_row(row) for row in results["poses"]]), source(results)]
    return parts


def pose_row(row: dict) -> list[str]:
    times = (with_95(row[f"{name}_ms"], row[f"{name}_95_ms"]) for name in POSE_TIMES)
    return [NAMES[row["kind"]], "left whole" if row.get("whole") else "in pieces", f"{row['carried']:,}", *times]


def at_rest(files: list[dict]) -> list[str]:
    """The scenes at rest: as they were placed, and fitted where they were."""
    rows = []
    for scene in (scene for results in files for scene in results["scenes"]):
        states = (scene["placed"], scene) if "placed" in scene else (scene,)
        cells = [cell for state in states for cell in with_unit(state)]
        rows.append([scene["scene"], f"{scene['splats']:,}", *cells, *["–"] * (4 - len(cells))])
    return [table(["scene", "splats", "as placed, PSNR", "SSIM", "fitted, PSNR", "SSIM"], rows)]


def with_unit(measured: dict) -> list[str]:
    psnr, ssim = quality(measured)
    return [f"{psnr} dB", ssim]


class Rows:
    """Rows by scene, pose, kind, map and what they measure."""

    def __init__(self, files: list[dict]):
        names = ("scene", "pose", "kind", "map", "what")
        self._rows = {tuple(row[name] for name in names): row for results in files for row in results["rows"]}
        self._scenes = list(dict.fromkeys(scene["scene"] for results in files for scene in results["scenes"]))

    def places(self, map: str = "forward") -> list[tuple[str, str]]:
        """Scenes with their poses."""
        there = {(scene, pose) for scene, pose, _, at, _ in self._rows if at == map}
        return [(scene, pose) for scene in self._scenes for pose in POSES if (scene, pose) in there]

    def get(self, scene: str, pose: str, kind: str, what: str = "deformer", map: str = "forward") -> dict | None:
        return self._rows.get((scene, pose, kind, map, what))

    def beside(self, scene: str, pose: str, what: str, kind: str = "mean_value") -> float | None:
        """dB of a shortcut beside the deformer."""
        one, other = self.get(scene, pose, kind, what), self.get(scene, pose, kind)
        return None if one is None or other is None else one["psnr"] - other["psnr"]


def to_rest(row: dict | None) -> str:
    return decibels(row and row["to_ceiling"])


def forward(files: list[dict]) -> list[str]:
    found = Rows(files)
    head = ["scene", "pose", "turn", "stretch", *NAMES.values(), *SHORTCUTS]
    return [table(head, [forward_row(found, *place) for place in found.places()])]


def forward_row(found: Rows, scene: str, pose: str) -> list[str]:
    facts = next(row for kind in NAMES if (row := found.get(scene, pose, kind)) is not None)
    return [
        scene,
        pose,
        f"{facts['turn']:.0f}°",
        "{:.2f}–{:.2f}".format(*facts["stretch"]),
        *(to_rest(found.get(scene, pose, kind)) for kind in NAMES),
        *(decibels(found.beside(scene, pose, what)) for what in SHORTCUTS),
    ]


def light(files: list[dict]) -> list[str]:
    found = Rows(files)
    rows = []
    for scene, pose in found.places():
        gains = [found.beside(scene, pose, "truth turned", kind) for kind in NAMES]
        if "gloss" in scene and any(gain is not None for gain in gains):
            rows.append([scene, pose, *map(decibels, gains)])
    return [table(["scene", "pose", *NAMES.values()], rows)]


def backward(files: list[dict]) -> list[str]:
    found = Rows(files)
    head = ["scene", "pose", *NAMES.values(), *(f"forward, {kind}" for kind in NAMES.values())]
    rows = [
        [
            *place,
            *(to_rest(found.get(*place, kind, what, "backward")) for what in ("deformer", "forward") for kind in NAMES),
        ]
        for place in found.places("backward")
    ]
    return [table(head, rows)]
