"""A long run: poses, fits and refused files in one process, with its memory, descriptors and temporary files watched.

    python benchmarks/soak.py --json docs/results/soak_cpu.json --figure docs/pictures/soak_cpu.svg
    python benchmarks/soak.py --device cuda:0 --json soak_cuda.json --figure soak_cuda.svg

1,000 poses with a frame each, 200 fits of small scenes, and as many damaged files as it takes for 10,000 to be refused.
Each part first runs for a while to fill caches and pools. What it holds is then sampled SAMPLES times until its end.
The exit status is 1 where memory of the process or of the device grows by more than GROWTH from the first sample to the
last, where more descriptors, threads or temporary files are open than at the first, or where a damaged file is met by
anything but one line.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import sys
import tempfile
import threading
import time
import warnings

import numpy as np
import warp as wp
from results import write_results

import warpcage
from warpcage.cage.pose_file import PoseFile
from warpcage.view.pictures import write_png

#: Times that a part is sampled, and its share that runs before the first.
SAMPLES, WARM = 50, 0.1

#: Megabytes that the process and the device may hold more at the end of a part than at its first sample.
GROWTH = 16.0

#: Megabytes of a page.
PAGE = os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--fits", type=int, default=200)
    parser.add_argument("--refused", type=int, default=10_000)
    parser.add_argument("--json")
    parser.add_argument("--figure", help="SVG file of the curves")
    args = parser.parse_args()
    wp.config.quiet = True
    parts = {}
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder  # whatever is left there shows
        for name, run, count in (
            ("poses", poses, args.poses),
            ("fits", fits, args.fits),
            ("refused files", refusals, args.refused),
        ):
            begin = time.perf_counter()
            parts[name] = sampled(run(pathlib.Path(folder), args.device), count, args.device, folder)
            parts[name]["seconds"] = time.perf_counter() - begin
            print(f"{name:14} {count:6d} in {parts[name]['seconds']:6.1f} s: {summary(parts[name])}", flush=True)
    grown = {name: found for name, part in parts.items() if (found := growth(part))}
    for name, found in grown.items():
        print(f"{name}: grew: {found}")
    if args.json:
        write_results(args.json, args.device, parts=parts, limit_megabytes=GROWTH, grown=grown)
    if args.figure:
        pathlib.Path(args.figure).write_text(figure(parts), encoding="utf-8")
    return 1 if grown else 0


def held(device: str, folder: str) -> dict[str, float]:
    """What the process holds now: megabytes of memory, here and on the device, descriptors, threads, files."""
    wp.synchronize_device(device)
    with open("/proc/self/statm", encoding="ascii") as file:
        resident = int(file.read().split()[1]) * PAGE
    on_device = wp.get_device(device)
    pool = wp.get_mempool_used_mem_current(on_device) / 2**20 if on_device.is_cuda else 0.0
    return {
        "resident": resident,
        "device": pool,
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "files": sum(len(names) for _, _, names in os.walk(folder)),
    }


def sampled(work, count: int, device: str, folder: str) -> dict:
    """Take `count` items of a generator; the curves of what is held meanwhile."""
    begin = max(1, int(WARM * count))
    marks = sorted({int(n) for n in np.linspace(begin, count, SAMPLES)})
    curves: dict[str, list] = {"items": []}
    for n in range(1, count + 1):
        next(work)
        if n in marks:
            curves["items"].append(n)
            for name, value in held(device, folder).items():
                curves.setdefault(name, []).append(value)
    work.close()
    return curves


def growth(part: dict) -> dict[str, float]:
    """What a part holds too much of at its end, and by how much."""
    limits = {"resident": GROWTH, "device": GROWTH, "descriptors": 0, "threads": 0, "files": 0}
    return {
        name: part[name][-1] - part[name][0] for name, limit in limits.items() if part[name][-1] - part[name][0] > limit
    }


def summary(part: dict) -> str:
    names = {"resident": "MB", "device": "MB on the device", "descriptors": "descriptors", "threads": "threads"}
    return ", ".join(f"{part[name][0]:.0f} to {part[name][-1]:.0f} {unit}" for name, unit in names.items())


def ball_field(device: str) -> warpcage.VoxelField:
    """A ball of radius 0.8, coloured by place."""
    n = 24
    nodes = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), axis=-1)
    sh = np.zeros((n, n, n, 9, 3), np.float32)
    sh[..., 0, :] = nodes
    density = np.where(np.linalg.norm(nodes, axis=-1) < 0.8, 20.0, 0.0).astype(np.float32)
    return warpcage.VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device=device)


def poses(folder: pathlib.Path, device: str):
    """A pose and its frame each time: kinds of coordinates, stores and numbers of edits in turns."""
    field, cage = ball_field(device), warpcage.Cage.icosphere((0, 0, 0), 1.2)
    camera = warpcage.turntable((0, 0, 0), 4.0, 20, 1, width=24, height=24)[0]
    near, far = cage, cage.translate((0.0, 0.0, 3.0))
    deformers = [
        (warpcage.Deformer(field, cage, coordinates=kind, resolution=12, store=store), None)
        for kind, store in (("harmonic", "map"), ("mean_value", "map"), ("green", "map"), ("mean_value", "weights"))
    ]
    copies = [warpcage.CageEdit(near, keep_source=True), warpcage.CageEdit(near)]
    deformers.append((warpcage.Deformer(field, copies, resolution=12), far))
    n = 0
    while True:
        deformer, other = deformers[n % len(deformers)]
        pose = cage.twist(60.0 * np.sin(0.1 * n))
        frame = deformer.pose(pose if other is None else [other, pose]).render(camera)
        assert np.isfinite(frame.rgb).all()
        n += 1
        yield


def fits(folder: pathlib.Path, device: str):
    """A fit of pictures of the ball each time, of another size or with other options, in turns."""
    field = ball_field(device)
    options = (
        {},
        {"background": "layers", "background_layers": 2},
        {"supersampling": 2},
        {"background": "outer"},
        {"max_memory": "40MB"},
    )
    n = 0
    while True:
        size = 12 + 4 * (n % 3)
        cameras = warpcage.turntable((0, 0, 0), 4.0, 20, 6, width=size, height=size)
        frames = [field.render(camera) for camera in cameras]
        kind = options[n % len(options)]
        alphas = None if "background" in kind else np.stack([frame.alpha for frame in frames])
        scene = warpcage.Scene(np.stack([frame.rgb for frame in frames]).clip(0, 1), alphas, cameras)
        fitted = warpcage.fit(scene, device=device, progress=False, resolution=16, levels=2, epochs=2, **kind)
        fitted.save(folder / "fitted.npz")
        n += 1
        yield


def refusals(folder: pathlib.Path, device: str):
    """A damaged file that is refused each time: fields, scenes, cages, poses and pictures in turns."""
    readers = valid_files(folder, device)
    random = np.random.default_rng(0)
    names = list(readers)
    n = 0
    while True:
        path, read = readers[names[n % len(names)]]
        whole = path.read_bytes()
        path.write_bytes(damaged(whole, random))
        n += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read()
        except (ValueError, OSError) as error:
            assert str(error) and "\n" not in str(error), f"{names[n % len(names)]}: {error!r}"
            refused = True
        else:
            refused = False
        path.write_bytes(whole)
        if refused:
            yield


def valid_files(folder: pathlib.Path, device: str) -> dict:
    """name: (file, function that reads it), one for each kind of file."""
    field, cage = ball_field(device), warpcage.Cage.icosphere((0, 0, 0), 1.2)
    field.save(folder / "field.npz")
    readers = {"field": (folder / "field.npz", lambda: warpcage.VoxelField.load(folder / "field.npz", device=device))}
    for ending in ("obj", "ply", "off", "glb", "gltf"):
        path = folder / f"cage.{ending}"
        cage.save(path)
        readers[ending] = path, lambda path=path: warpcage.Cage.load(path)
    poses = PoseFile(cage, {"rest": cage, "twisted": cage.twist(20)})
    poses.save(folder / "poses.json")
    readers["poses"] = folder / "poses.json", lambda: PoseFile.load(folder / "poses.json", cage)
    camera = warpcage.turntable((0, 0, 0), 4.0, 20, 1, width=16, height=16)[0]
    frame = field.render(camera)
    scene = folder / "scene"
    scene.mkdir()
    write_png(scene / "r_0.png", np.concatenate([frame.rgb, frame.alpha[..., None]], axis=-1))
    matrix = camera.camera_to_world * [1, -1, -1, 1]  # OpenGL axes
    content = {"camera_angle_x": 0.7, "frames": [{"file_path": "./r_0", "transform_matrix": matrix.tolist()}]}
    (scene / "transforms_train.json").write_text(json.dumps(content), encoding="utf-8")
    for name in ("transforms_train.json", "r_0.png"):
        readers[name] = scene / name, lambda: warpcage.load_scene(scene)
    for _, read in readers.values():
        read()  # they are valid
    return readers


def damaged(content: bytes, random) -> bytes:
    """Cut, with bytes changed, taken out, put in or said twice."""
    kind, at, size = random.integers(5), int(random.integers(len(content))), int(random.integers(1, 40))
    if kind == 0:
        return content[:at]
    if kind == 1:
        return content[:at] + random.bytes(size) + content[at + size :]
    if kind == 2:
        return content[:at] + content[at + size :]
    if kind == 3:
        return content[:at] + random.bytes(size) + content[at:]
    return content[: at + size] + content[at:]


def figure(parts: dict) -> str:
    """An SVG picture: a row per part; memory, descriptors and files against the items done."""
    width, height, left, top = 250, 110, 60, 40
    columns = (("resident", "resident memory, MB"), ("device", "memory of the device, MB"),
               ("descriptors", "descriptors"), ("files", "temporary files"))  # fmt: skip
    columns = [column for column in columns if any(max(part[column[0]]) > 0 for part in parts.values())]
    full = left + len(columns) * (width + left), top + len(parts) * (height + top)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{full[0]}" height="{full[1]}" font-family="sans-serif" '
        'font-size="11">',
        f'<rect width="{full[0]}" height="{full[1]}" fill="white"/>',
    ]
    for row, (name, part) in enumerate(parts.items()):
        for column, (key, title) in enumerate(columns):
            x0, y0 = left + column * (width + left), top + row * (height + top)
            values, items = np.array(part[key]), np.array(part["items"])
            most = max(1.0, 1.25 * values.max())
            x = x0 + width * items / items[-1]
            y = y0 + height * (1 - values / most)
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
            lines += [
                f'<text x="{x0}" y="{y0 - 8}">{name}: {title}</text>',
                f'<path d="M{x0},{y0}V{y0 + height}H{x0 + width}" fill="none" stroke="#888"/>',
                f'<text x="{x0 - 6}" y="{y0 + 10}" text-anchor="end">{most:.0f}</text>',
                f'<text x="{x0 - 6}" y="{y0 + height}" text-anchor="end">0</text>',
                f'<text x="{x0 + width}" y="{y0 + height + 14}" text-anchor="end">{items[-1]}</text>',
                f'<polyline points="{points}" fill="none" stroke="#c40" stroke-width="1.5"/>',
            ]
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    sys.exit(main())
