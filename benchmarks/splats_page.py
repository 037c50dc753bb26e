"""Write the page docs/splats_views.md from the JSON files of splats.py, splat_poses.py and splats_truth.py.

    python benchmarks/splats_page.py --results docs/results --page docs/splats_views.md

Files are those of the folder whose names begin with "splats_times", "splat_poses" and "splats_truth"; the text before
them is splats_text.md.
"""

from __future__ import annotations

import json
import math
import pathlib

from page import KINDS, POSES, page_arguments, source, table

TEXT = pathlib.Path(__file__).with_name("splats_text.md")

#: What a Deformer leaves out in each of these rows.
SHORTCUTS = ("no turn", "no split", "full opacity", "GSDeformer")

#: What is timed of a pose.
POSE_TIMES = ("pose", "without_check", "centres_and_jacobians")

#: A shortcut that costs so much is one to speak of, dB; a pose that turns less than this hardly turns, degrees.
CLEAR, STILL = 1.0, 5.0


def main() -> None:
    args = page_arguments(__doc__, "docs/splats_views.md")
    parts = [TEXT.read_text(encoding="utf-8")]
    sections = {"splats_times*.json": times, "splat_poses*.json": poses, "splats_truth*.json": truth}
    for pattern, section in sections.items():
        paths = sorted(pathlib.Path(args.results).glob(pattern))
        if paths:
            files = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
            parts += section(files, pathlib.Path(args.page).parent / "pictures")
        else:
            print(f"no {pattern} in {args.results}: section left out")
    if len(parts) == 1:
        raise SystemExit(f"no results in {args.results}: run benchmarks/splats_truth.py --json first")
    pathlib.Path(args.page).write_text("\n".join(parts), encoding="utf-8")
    print(f"{args.page}: {len(parts)} parts")


# Times


def times(files: list[dict], pictures: pathlib.Path) -> list[str]:
    parts = [TIMES]
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


def with_95(median: float, high: float) -> str:
    return f"{median:.3f} ({high:.3f})"


# Poses


def poses(files: list[dict], pictures: pathlib.Path) -> list[str]:
    parts = [POSES_OF_SPLATS]
    for results in files:
        head = ["coordinates", "splats", "sums", "whole pose, ms (95 %)", "without check", "centres and Jacobians"]
        shape = f"{results['splats']:,} splats of degree 3 in a cage of {results['cage_vertices']} vertices:\n"
        parts += [shape, table(head, [pose_row(row) for row in results["poses"]]), source(results)]
    return parts


def pose_row(row: dict) -> list[str]:
    times = (with_95(row[f"{name}_ms"], row[f"{name}_95_ms"]) for name in POSE_TIMES)
    return [KINDS[row["kind"]], "left whole" if row.get("whole") else "in pieces", f"{row['carried']:,}", *times]


# Truth


def truth(files: list[dict], pictures: pathlib.Path) -> list[str]:
    scenes = {scene["scene"]: scene for results in files for scene in results["scenes"]}
    found = Rows([row for results in files for row in results["rows"]])
    shown = [name for name in scenes if (pictures / file_name(name)).exists()]
    return [
        *at_rest(scenes),
        FORWARD,
        table(
            ["scene", "pose", "turn", "stretch", *KINDS.values(), *SHORTCUTS],
            [forward_row(found, name, pose) for name in scenes for pose in POSES if found.has(name, pose)],
        ),
        verdict(found, list(scenes)),
        LIGHT,
        light(found, list(scenes)),
        BACKWARD,
        table(
            ["scene", "pose", *KINDS.values(), *(f"forward, {kind}" for kind in KINDS.values())],
            [backward_row(found, name, pose) for name in scenes for pose in POSES if found.has(name, pose, "backward")],
        ),
        *(f"![{name}: truth, deformer and GSDeformer](pictures/{file_name(name)})\n" for name in shown),
        PICTURES if shown else "",
        *dict.fromkeys(source(results) for results in files),
    ]


def at_rest(scenes: dict[str, dict]) -> list[str]:
    """What was measured, and the scenes at rest: as they were placed, and fitted where they were."""
    if not any("placed" in scene for scene in scenes.values()):
        rows = [[name, f"{scene['splats']:,}", *quality(scene)] for name, scene in scenes.items()]
        return [TRUTH + " At rest:\n", table(["scene", "splats", "at rest, PSNR", "SSIM"], rows)]
    rows = []
    for name, scene in scenes.items():
        states = (scene["placed"], scene) if "placed" in scene else (scene,)
        cells = [cell for state in states for cell in quality(state)]
        rows.append([name, f"{scene['splats']:,}", *cells, *["–"] * (4 - len(cells))])
    return [TRUTH + FITTED, table(["scene", "splats", "as placed, PSNR", "SSIM", "fitted, PSNR", "SSIM"], rows)]


def quality(measured: dict) -> list[str]:
    return [f"{measured['psnr']:.2f} dB", f"{measured['ssim']:.4f}"]


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


def decibels(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"


def to_rest(row: dict | None) -> str:
    return decibels(row and row["to_ceiling"])


def forward_row(found: Rows, scene: str, pose: str) -> list[str]:
    facts = next(row for kind in KINDS if (row := found.get(scene, pose, kind)) is not None)
    return [
        scene,
        pose,
        f"{facts['turn']:.0f}°",
        "{:.2f}–{:.2f}".format(*facts["stretch"]),
        *(to_rest(found.get(scene, pose, kind)) for kind in KINDS),
        *(decibels(found.beside(scene, pose, what)) for what in SHORTCUTS),
    ]


def backward_row(found: Rows, scene: str, pose: str) -> list[str]:
    rows = [found.get(scene, pose, kind, what, "backward") for what in ("deformer", "forward") for kind in KINDS]
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
        f"On the scenes that change with the direction, the GSDeformer way is {CLEAR:g} dB or more below\n"
        f"the deformer in {len(clear)} of {len(costs)} poses"
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
            gains = [found.beside(scene, pose, "truth turned", kind) for kind in KINDS]
            if "gloss" in scene and any(gain is not None for gain in gains):
                lines.append([scene, pose, *map(decibels, gains)])
    return table(["scene", "pose", *KINDS.values()], lines)


def file_name(scene: str) -> str:
    return f"splats_truth_{scene.replace(', ', '_')}.jpg"


TIMES = """## Times

Whole frames, kernels compiled before; medians. On a CPU: the processor time of all threads, as other programs ran
beside it. On an H200 frames went by turns with those of gsplat 1.5.3 (its forward kernels, built for torch), and on
another H200 by themselves; much of a frame is the host's part ([notes](../benchmarks/NOTES-splats.md)), so that hosts
differ. The aims were 1.6 ms for 300,000 splats at 800x800, and 45 dB to gsplat. Where the ratio is below 1 gsplat is
the faster one.
"""

POSES_OF_SPLATS = """## Times of poses

From the call to the last kernel: the check of the posed cage, the sums, covariances, turns and, of splats in pieces,
which pieces are drawn. Pieces are bound as splats are, so that there are more sums than splats; "left whole" is without
them. "Centres and Jacobians" is the sums alone. Every pose is new. The aims for 300,000 splats and 100 vertices were
0.5 ms for a new pose, and 1 ms with covariances, harmonics and splits.
"""

TRUTH = """## Posed splats and ground truth

`benchmarks/splats_truth.py` lays flat splats on the reference models: they reach to their neighbours, or to the next
edge, and their harmonics are those that best fit the colours of their place from all sides. Cages of 60 vertices pose
them, and the pictures are compared with the ray cast model where the same map takes its vertices; colours, shadows and
highlights go along and are seen in the direction J^-1 d, J the Jacobian of the map, as in [results](results.md).
"gloss" has broad, strong highlights; the splats of "long" are few and long."""

FITTED = """

Then `fit_splats` fits them to pictures of the model at rest from all around it, from below too
([splats.md](splats.md#fits)). The test has other views, and no fit sees a pose. No splat is added, and none grows to
more than 1.5 times its length. At rest, as they were placed and fitted:
"""

FORWARD = """### Forward, and what shortcuts cost

"turn" is the mean angle by which the pose turns the model, "stretch" the range of its singular values. Columns of
coordinates: PSNR beside that of the splats at rest, dB. Columns of shortcuts (mean value coordinates): dB beside the
deformer; "–" where no splat is cut.

- no turn: harmonics as they are at rest;
- no split: long splats stay whole where the cage bends, and at its walls, through which their ends reach;
- full opacity: the pieces of a splat are as opaque as the whole;
- GSDeformer: seven points of each splat by mean value coordinates, harmonics unturned, halves as opaque as the whole
  (Huang et al. 2024, in our own reading).
"""

LIGHT = """What that way gets wrong in these scenes is the turn of the harmonics: where a pose does not turn the matter,
but stretches it or moves a small part, there is nothing to turn. Of what the deformer itself loses in a stretch, a part
is the law of light: files of splats can hold harmonics that are turned, by the rotation nearest to J, but not ones that
are seen along J^-1 d. So much nearer are the same pictures to a truth whose highlights are turned, dB; what is left is
what the plain scene loses too, as the same discs show a longer surface:
"""

BACKWARD = """### Backward, where voxels are

The same with `map="backward"`, against the model where the voxels' map puts it (Newton's iteration in float64; closed
forms, or boundary elements for harmonic coordinates): the deformer, and on the right splats that went forward instead,
both beside the splats at rest, dB.
"""

PICTURES = """From left to right: truth, the deformer, the GSDeformer way; mean value coordinates, one line for a pose.
Made by the commands below with `--figures`.
"""


if __name__ == "__main__":
    main()
