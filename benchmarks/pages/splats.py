"""Tables of the page of splats: times, poses, ground truth."""

from __future__ import annotations

import math
import pathlib

from pages.tables import NAMES, POSES, decibels, quality, source, table, texts, with_95

TEXTS = texts("splats_views")

#: What a Deformer leaves out in each of these rows.
SHORTCUTS = ("no turn", "no split", "full opacity", "GSDeformer")

#: What is timed of a pose.
POSE_TIMES = ("pose", "without_check", "centres_and_jacobians")

#: A shortcut that costs so much is one to speak of, dB; a pose that turns less than this hardly turns, degrees.
CLEAR, STILL = 1.0, 5.0


def times_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    parts = [TEXTS["times"]]
    for results in files:
        rows = results["rows"]
        on_cpu = "processor_ms" in rows[0]
        head = ["splats", "picture", "processor time, ms" if on_cpu else "ms (95 %)"]
        with_peer = any("gsplat_ms" in row for row in rows)
        head += ["gsplat, ms (95 %)", "gsplat / warpcage", "PSNR to gsplat, dB"] if with_peer else []
        parts += [table(head, [time_row(row, with_peer) for row in rows]), source(results)]
    return parts


def time_row(row: dict, with_peer: bool) -> list[str]:
    degree = f"of degree {row['degree']}" if row["degree"] else "without harmonics"
    antialiased = ", antialiased" if row["antialias"] else ""
    if "processor_ms" in row:
        took = f"{row['processor_ms']:.0f}"
    else:
        took = with_95(*row["ms"])
    cells = [f"{row['splats']:,} {degree}{antialiased}", f"{row['size']}x{row['size']}", took]
    if with_peer:
        ratio, agreement = f"{row['gsplat_over_ours']:.2f}", f"{row['psnr_to_gsplat']:.1f}"
        cells += [with_95(*row["gsplat_ms"]), ratio, agreement]
    return cells


def poses_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    parts = [TEXTS["poses"]]
    for results in files:
        head = ["coordinates", "splats", "sums", "whole pose, ms (95 %)", "without check", "centres and Jacobians"]
        shape = f"{results['splats']:,} splats of degree 3 in a cage of {results['cage_vertices']} vertices:\n"
        parts += [shape, table(head, [pose_row(row) for row in results["poses"]]), source(results)]
    return parts


def pose_row(row: dict) -> list[str]:
    times = (with_95(row[f"{name}_ms"], row[f"{name}_95_ms"]) for name in POSE_TIMES)
    return [NAMES[row["kind"]], "left whole" if row.get("whole") else "in pieces", f"{row['carried']:,}", *times]


def truth_parts(files: list[dict], pictures: pathlib.Path) -> list[str]:
    scenes = {scene["scene"]: scene for results in files for scene in results["scenes"]}
    found = Rows([row for results in files for row in results["rows"]])
    shown = [name for name in scenes if (pictures / file_name(name)).exists()]
    return [
        *at_rest(scenes),
        TEXTS["forward"],
        table(
            ["scene", "pose", "turn", "stretch", *NAMES.values(), *SHORTCUTS],
            [forward_row(found, name, pose) for name in scenes for pose in POSES if found.has(name, pose)],
        ),
        verdict(found, list(scenes)),
        TEXTS["light"],
        light(found, list(scenes)),
        TEXTS["backward"],
        table(
            ["scene", "pose", *NAMES.values(), *(f"forward, {kind}" for kind in NAMES.values())],
            [backward_row(found, name, pose) for name in scenes for pose in POSES if found.has(name, pose, "backward")],
        ),
        *(f"![{name}: truth, deformer and GSDeformer](pictures/{file_name(name)})\n" for name in shown),
        TEXTS["pictures"] if shown else "",
        *dict.fromkeys(source(results) for results in files),
    ]


def at_rest(scenes: dict[str, dict]) -> list[str]:
    """What was measured, and the scenes at rest: as they were placed, and fitted where they were."""
    if not any("placed" in scene for scene in scenes.values()):
        rows = [[name, f"{scene['splats']:,}", *with_unit(scene)] for name, scene in scenes.items()]
        return [TEXTS["truth"].rstrip() + " At rest:\n", table(["scene", "splats", "at rest, PSNR", "SSIM"], rows)]
    rows = []
    for name, scene in scenes.items():
        states = (scene["placed"], scene) if "placed" in scene else (scene,)
        cells = [cell for state in states for cell in with_unit(state)]
        rows.append([name, f"{scene['splats']:,}", *cells, *["–"] * (4 - len(cells))])
    return [
        TEXTS["truth"] + "\n" + TEXTS["fitted"],
        table(["scene", "splats", "as placed, PSNR", "SSIM", "fitted, PSNR", "SSIM"], rows),
    ]


def with_unit(measured: dict) -> list[str]:
    psnr, ssim = quality(measured)
    return [f"{psnr} dB", ssim]


class Rows:
    """Rows by scene, pose, kind, map and what they measure."""

    def __init__(self, rows: list[dict]):
        names = ("scene", "pose", "kind", "map", "what")
        self._rows = {tuple(row[name] for name in names): row for row in rows}

    def has(self, scene: str, pose: str, map: str = "forward") -> bool:
        return any(key[:2] == (scene, pose) and key[3] == map for key in self._rows)

    def get(self, scene: str, pose: str, kind: str, what: str = "deformer", map: str = "forward") -> dict | None:
        return self._rows.get((scene, pose, kind, map, what))

    def beside(self, scene: str, pose: str, what: str, kind: str = "mean_value") -> float | None:
        """dB of a shortcut beside the deformer."""
        one, other = self.get(scene, pose, kind, what), self.get(scene, pose, kind)
        return None if one is None or other is None else one["psnr"] - other["psnr"]


def to_rest(row: dict | None) -> str:
    return decibels(row and row["to_ceiling"])


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


def backward_row(found: Rows, scene: str, pose: str) -> list[str]:
    rows = [found.get(scene, pose, kind, what, "backward") for what in ("deformer", "forward") for kind in NAMES]
    return [scene, pose, *map(to_rest, rows)]


def verdict(found: Rows, scenes: list[str]) -> str:
    """Where the GSDeformer way is clearly worse on scenes that change with the direction, and where not."""
    costs = {
        (scene, pose): cost
        for scene in scenes
        if "gloss" in scene
        for pose in POSES
        if (cost := found.beside(scene, pose, "GSDeformer")) is not None
    }
    clear = {place: cost for place, cost in costs.items() if cost <= -CLEAR}
    others = {place: cost for place, cost in costs.items() if cost > -CLEAR}
    said = [
        (
            f"On the scenes that change with the direction, the GSDeformer way is {CLEAR:g} dB or more below\n"
            f"the deformer in {len(clear)} of {len(costs)} poses"
        )
    ]
    if clear:
        said.append(f", by {-max(clear.values()):.1f} to {-min(clear.values()):.1f} dB")
    if others:
        said.append(". It is not in:\n")
        said += [
            f"\n- {scene}, {pose}: {cost:+.2f} dB; {reason(found, scene, pose)}"
            for (scene, pose), cost in others.items()
        ]
        return "".join(said) + "\n"
    return "".join(said) + ".\n"


def reason(found: Rows, scene: str, pose: str) -> str:
    """Why the GSDeformer way is hardly worse there."""
    one, other = found.get(scene, pose, "mean_value"), found.get(scene, pose, "mean_value", "GSDeformer")
    assert one is not None and other is not None
    added = 10.0 ** (-other["psnr"] / 10.0) - 10.0 ** (-one["psnr"] / 10.0)
    if one["turn"] < STILL or added <= 0.0:
        return f"the pose turns the model by {one['turn']:.0f}° on average"
    alone = -10.0 * math.log10(added)
    return (
        f"its error alone is one of {alone:.1f} dB, but the splats are {one['psnr']:.1f} dB from the model in any case"
    )


def light(found: Rows, scenes: list[str]) -> str:
    lines = []
    for scene in scenes:
        for pose in POSES:
            gains = [found.beside(scene, pose, "truth turned", kind) for kind in NAMES]
            if "gloss" in scene and any(gain is not None for gain in gains):
                lines.append([scene, pose, *map(decibels, gains)])
    return table(["scene", "pose", *NAMES.values()], lines)


def file_name(scene: str) -> str:
    return f"splats_truth_{scene.replace(', ', '_')}.jpg"
