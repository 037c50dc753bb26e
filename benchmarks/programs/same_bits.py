"""What two checkouts make of the same commands and job files, byte by byte."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import pathlib
import subprocess
import sys
import tempfile

from common import HERE, UsageError, command, option

#: What both trees get, made by the first: a field of two balls, splats of it, cages, poses, cameras.
INPUTS = """
import importlib, pathlib, numpy as np, warpcage
is_new = (pathlib.Path(warpcage.__file__).parent / "demo").is_dir()  # not up to version 0.2
demo = importlib.import_module("warpcage.demo" if is_new else "warpcage.reference")
places = np.linspace(-0.975, 0.975, 40)
x, y, z = np.meshgrid(places, places, places, indexing="ij")
far = np.minimum(np.hypot(np.hypot(x, y), z - 0.2) - 0.5, np.hypot(np.hypot(x - 0.4, y), z + 0.5) - 0.3)
density = np.where(far < 0, 40.0, 0.0).astype(np.float32)
sh = np.zeros((40, 40, 40, 9, 3), np.float32)
sh[..., 0, :] = np.stack([x, y, z], axis=-1)
sh[..., 2, 0] = 0.3
field = warpcage.VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device="cpu")
field.save("balls.npz")
warpcage.to_splats(field, most=1500).save("balls.ply")
demo.write_brick_scene("scene", train_views=8, test_views=1, size=24, device="cpu")
cage = warpcage.Cage.box([-0.7, -0.7, -0.95], [0.8, 0.7, 0.8], segments=3)
cage.save("cage.obj")
np.save("poses.npy", np.stack([np.asarray(cage.vertices) * (1, 1, 1 + 0.1 * k) for k in range(4)]))
"""

#: A session of the editor, with a film of two keys, and what its page exports: film, frames, baked field, cage, poses.
EXPORTS = """
import dataclasses, importlib, pathlib, warpcage
studio = "studio." if (pathlib.Path(warpcage.__file__).parent / "studio").is_dir() else ""  # not up to version 0.2
editor = importlib.import_module(f"warpcage.{studio}editor")
field, cage = warpcage.VoxelField.load("balls.npz", device="cpu"), warpcage.Cage.load("cage.obj")
bent = cage.bend(40, axis="x", towards="z").vertices
made = editor.new_document(field, [cage], resolution=24)
other = dataclasses.replace(made.view, fov=50.0)
keys = (
    editor.Key(10, 0.0, "rest", "smooth", {1: editor.frozen_vertices(cage.vertices)}, made.view),
    editor.Key(11, 0.5, "bent", "linear", {1: editor.frozen_vertices(bent)}, other),
)
edits = (editor.new_edit(1, cage, "Move 1", posed=bent),)
made = dataclasses.replace(made, edits=edits, timeline=editor.Timeline(keys, length=0.5, fps=6.0), next_id=99)
editor.write_session("balls.session.json", made, field, "balls.npz")
editor.export_film(made, field, "exported.gif", editor.Film(48, 36, overlay=True))
editor.export_film(made, field, "exported", editor.Film(48, 36, transparent=True))
editor.export_baked(made, field, "exported.npz")
editor.export_cage(made, 1, "exported.obj")
editor.export_poses(made, 1, "exported.json")
"""

#: Views, and edits, that lines below name; what they write is compared, never what they print.
VIEW = "--size 64 --eye 2.4 -2 1.4 --target 0 0 0"
BEND = "--cage cage.obj --posed bend:40:x:z --resolution 24"
COMMANDS = f"""
mesh balls.npz -o balls.obj
mesh balls.npz -o colored.ply --colors
mesh balls.npz -o balls.glb
mesh balls.npz -o low.off --threshold 10 --components all
mesh balls.npz -o balls.stl
clean balls.npz -o clean.npz
select balls.npz -o lower.json --sphere 0.4 0 -0.5 0.4 --plane none
select balls.npz -o upper.npz --in-box -0.6 -0.6 -0.2 0.6 0.6 0.9 --plane none --preview upper.png {VIEW}
cage balls.npz -o box.obj --box --segments 2 2 3
cage balls.npz -o round.obj --cylinder --axis z --sides 8 --rings 4
cage balls.npz -o box.glb --box
cage balls.npz -o cut.obj --box --in-box -0.6 -0.6 -0.1 0.6 0.6 0.9
cage balls.npz -o lower.ply --box --selection lower.json
pose cage.obj -o bent.obj --bend 40 --axis x --towards z
pose cage.obj -o twisted.ply --twist 60 --axis z
pose cage.obj -o tapered.glb --taper 0.5 --axis=-z
pose cage.obj -o wide.obj --scale 1.3 0.8 1
pose cage.obj -o turned.off --rotate 30 --axis y --translate 0.1 0 0.2
pose cage.obj -o keys.json --key up --at 0.5 --stretch 1.3 --axis z
pose cage.obj -o keys.json --key down --at 1 --easing linear --stretch 0.8 --axis z
edits -o two.json --edit cage.obj:bent.obj:keep --edit cage.obj:translate:0:0:0.4
render balls.npz -o rest.png {VIEW} --depth rest_depth.png --alpha rest_alpha.png --disparity rest_disparity.png
render balls.npz -o rest.exr {VIEW}
render balls.npz -o bent.png {VIEW} {BEND} --masks bent_masks.png --overlay
render balls.npz -o bent_green.png {VIEW} {BEND} --coordinates green
render balls.npz -o bent_mean.png {VIEW} {BEND} --coordinates mean_value --density paper
render balls.npz -o bent_file.png {VIEW} --cage cage.obj --posed bent.obj --resolution 24 --transparent
render balls.npz -o edits.png {VIEW} --edits two.json --resolution 24
render balls.npz -o edit.png {VIEW} --edit cut.obj:twist:50:keep --falloff 0.2 --resolution 24
render balls.npz -o key.png {VIEW} --cage cage.obj --posed keys.json:up --resolution 24
render balls.npz -o corner.png --view corner --size 64 --save-camera corner.json
render balls.npz -o framed.png {BEND} --view left --frame posed --size 64 48
render balls.npz -o from_scene.png --camera scene:train:2 --size 48
render balls.npz -o orbit --cameras given --scene scene:train --size 32
render balls.npz -o poses {VIEW} --cage cage.obj --posed bend:20 twist:30 bent.obj --resolution 24
render balls.npz -o poses_exr {VIEW} --cage cage.obj --posed bend:20 twist:30 --resolution 24 --format exr
render balls.ply -o splats.png {VIEW}
render balls.ply -o splats_bent.png {VIEW} {BEND}
render balls.ply -o splats_back.png {VIEW} {BEND} --map backward --antialias
render balls.ply -o splats_edits.png {VIEW} --edits two.json --resolution 24
animate balls.npz -o film --frames 4 --turn 90 {BEND} --size 64
animate balls.npz -o film.mp4 --frames 4 {BEND} --size 64
animate balls.npz -o keys.gif --fps 4 --cage cage.obj --posed keys.json --resolution 24 --size 64 --turn 0
animate balls.npz -o once --frames 3 --motion once --show depth {BEND} --size 48
animate balls.npz -o masks --frames 3 --motion hold --show masks {BEND} --size 48
animate balls.npz -o paths --frames 4 --cameras scene:train --size 32
animate balls.ply -o splat_film --frames 3 {BEND} --size 48
animate balls.npz --session balls.session.json -o session.gif --size 48 36
render balls.npz --edits balls.session.json -o session.png {VIEW} --resolution 24
animate balls.npz --jobs film.jsonl --frames 3 {BEND} --size 48
run film.jsonl -o film_made
bake balls.npz -o baked.npz {BEND}
bake balls.npz -o baked_green.npz {BEND} --coordinates green --voxels 48
bake balls.npz -o baked_svox2.npz {BEND} --format svox2
bake balls.npz -o baked_edits.npz --edits two.json --resolution 24
bake balls.ply -o baked.ply {BEND}
bake balls.ply -o baked.splat {BEND} --map backward
bake balls.ply -o walk_##.ply --frames 3 {BEND}
sweep balls.npz --cage cage.obj -o sweep.jsonl --poses random:2 twist:40 --cameras orbit:2 --size 32 --seeds 3
run sweep.jsonl -o sweep_made
run jobs.jsonl -o jobs_made
render baked.npz -o baked.png {VIEW}
render baked.ply -o baked_splats.png {VIEW}
fit scene -o fitted.npz --resolution 16 --epochs 1
fit scene -o fitted.ply --steps 30 --most-splats 300
evaluate fitted.npz scene --json fitted.json --split train --worst fitted_worst.png
"""

#: A job file with an item of each kind.
JOBS = [
    {
        "format": "warpcage jobs",
        "version": 1,
        "defaults": {
            "field": "balls.npz",
            "cage": "cage.obj",
            "resolution": 24,
            "camera": {"eye": [2.4, -2, 1.4], "target": [0, 0, 0], "width": 48, "height": 40},
        },
    },
    {"id": "rest", "posed": "rest"},
    {"id": "bent", "posed": "bend:40:x:z", "outputs": {"rgb": "{id}.png", "depth": "{id}.npy", "alpha": "{id}_a.png"}},
    {"id": "shot/a", "posed": "poses.npy#1"},
    {"id": "shot/b", "posed": "poses.npy#2", "coordinates": "green"},
    {"id": "random", "posed": {"random": {"seed": 0, "number": 12}}},
    {"id": "plain", "cage": None, "posed": None, "background": "transparent"},
    {
        "id": "twice",
        "cage": None,
        "edits": [
            {"cage": "cage.obj", "posed": "twist:60", "keep": True},
            {"cage": "cage.obj", "posed": "translate:0:0:1"},
        ],
    },
    {"id": "fit", "kind": "fit", "scene": "scene", "options": {"resolution": 16, "epochs": 0.5}, "output": "fit.npz"},
]

#: Runs commands of the tree that PYTHONPATH names, one after another, and writes how each ended.
RUNNER = """
import contextlib, importlib, io, json, pathlib, shlex, sys
import warpcage
studio = "studio." if (pathlib.Path(warpcage.__file__).parent / "studio").is_dir() else ""  # not up to version 0.2
main = importlib.import_module(f"warpcage.{studio}cli").main
ended = {}
for line in pathlib.Path(sys.argv[1]).read_text().splitlines():
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            status = main([*shlex.split(line)])
        except SystemExit as end:
            status = end.code
    ended[line] = [status or 0, said.getvalue()[-300:] if status else ""]
pathlib.Path(sys.argv[2]).write_text(json.dumps(ended))
"""


@command(
    option("other", type=pathlib.Path, help="checkout of another commit, such as one of `git worktree add`"),
    option("--only", nargs="*", default=[], help="commands that begin with one of these names"),
    option("--keep", type=pathlib.Path, help="folder for what both make (default: a temporary one)"),
)
def main(args: argparse.Namespace) -> int:
    """Run the same commands, job files and exports of the editor in this checkout and another one; name what differs.

        git worktree add ../before HEAD~20
        python benchmarks same-bits ../before

    On the CPU, with one number of threads. Files are compared by their bytes, NumPy archives by their arrays; what runs
    note of their time (manifests, logs) is left out. A command that only one of the two refuses is reported too.
    """
    if not (args.other / "warpcage" / "__init__.py").is_file():
        raise UsageError(f"{args.other} is no checkout of warpcage")
    with contextlib.ExitStack() as stack:
        folder = args.keep or pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        made = {name: folder / name for name in ("other", "this")}
        lines = [line for line in COMMANDS.strip().splitlines() if not args.only or line.split()[0] in args.only]
        ended = {
            name: run_in(tree.resolve(), made[name], lines)
            for name, tree in (("other", args.other), ("this", HERE.parent))
        }
        found = {name: contents(path) for name, path in made.items()}
    differences = [
        f"{line}: ends with {ended['other'][line]}, here {ended['this'][line]}"
        for line in lines
        if ended["other"][line][0] != ended["this"][line][0]
    ]
    both = sorted(set(found["other"]) & set(found["this"]))
    differences += [f"{name}: not there any more" for name in sorted(set(found["other"]) - set(both))]
    differences += [f"{name}: not there before" for name in sorted(set(found["this"]) - set(both))]
    differences += [f"{name}: differs" for name in both if found["other"][name] != found["this"][name]]
    refused = [line for line in lines if ended["this"][line][0]]
    print(
        "\n".join(
            [
                *differences,
                f"{len(lines)} commands, {len(refused)} refused; {len(both)} files, {len(differences)} differences",
            ]
        )
    )
    for line in refused:
        print(f"refused: {line}: {ended['this'][line][1].strip()}")
    return 1 if differences or refused else 0


def run_in(tree: pathlib.Path, folder: pathlib.Path, lines: list[str]) -> dict[str, list]:
    """How commands of a checkout end in a folder, which gets the inputs first."""
    folder.mkdir(parents=True)
    environment = {**os.environ, "PYTHONPATH": str(tree), "CUDA_VISIBLE_DEVICES": ""}

    def run(*arguments: str) -> None:
        subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)

    run("-c", INPUTS)
    run("-c", EXPORTS)
    (folder / "jobs.jsonl").write_text("".join(json.dumps(item) + "\n" for item in JOBS))
    (folder / "commands.txt").write_text("\n".join(lines))
    run("-c", RUNNER, "commands.txt", "ended.json")
    return json.loads((folder / "ended.json").read_text())


def contents(folder: pathlib.Path) -> dict[str, str]:
    """A hash of each file of a folder that is not a note of a run, by its name."""
    import numpy as np

    hashes = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir() or path.name in ("ended.json", "manifest.jsonl") or any(p.startswith(".") for p in path.parts):
            continue
        data = path.read_bytes()
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                data = b"".join(key.encode() + arrays[key].tobytes() for key in sorted(arrays))
        hashes[name] = hashlib.sha256(data).hexdigest()
    return hashes
