"""What a long run holds: of poses, fits and refused files, of a long film, of the workers of `warpcage run`."""

from __future__ import annotations

import functools
import json
import os
import pathlib
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator

import numpy as np
import warp as wp
from common import GROWTH, JSON, ball_field, command, option, resident, write_results, write_twists

import warpcage
import warpcage.studio.films.video as film
from warpcage import PoseFile
from warpcage.studio.films import BackgroundWriter
from warpcage.studio.jobs import ProcessEngine, run, write_jobs
from warpcage.view import write_png

#: Times that a part of a long run is sampled, and its share that runs before the first.
SAMPLES, WARM = 50, 0.1

#: Of films: times that memory is sampled, frames before the first, samples at both ends that are compared by their
#: means, megabytes that they may differ by, and pictures that are made beforehand and shown in turn.
FILM_SAMPLES, FILM_WARM, ENDS, FILM_GROWTH, PICTURES = 40, 120, 5, 48.0, 6

FILMS = ("mp4", "png", "mov", "webm")

#: Of batches: times that memory is looked at, and the share of the items that is made before it counts.
BATCH_SAMPLES, BATCH_WARM = 60, 0.2

CAMERA = {"eye": [3, 2, 1.5], "target": [0, 0, 0], "width": 32, "height": 32}


# A long run


@command(
    option("--device", default="cpu"),
    option("--poses", type=int, default=1000),
    option("--fits", type=int, default=200),
    option("--refused", type=int, default=10_000),
    JSON,
    option("--figure", help="SVG file of the curves"),
)
def soak(args) -> int:
    """A long run of poses, fits and refused files in one process: its memory, descriptors and temporary files.

        python benchmarks memory soak --json docs/results/soak_cpu.json --figure docs/pictures/soak_cpu.svg
        python benchmarks memory soak --device cuda:0 --json soak_cuda.json --figure soak_cuda.svg

    1,000 poses with a frame each, 200 fits of small scenes, and as many damaged files as it takes for 10,000 to be
    refused. Each part first runs for a while to fill caches and pools. What it holds is then sampled SAMPLES times
    until its end. The exit status is 1 where memory of the process or of the device grows by more than GROWTH from the
    first sample to the last, where more descriptors, threads or temporary files are open than at the first, or where a
    damaged file is met by anything but one line.
    """
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
    write_results(args.json, args.device, parts=parts, limit_megabytes=GROWTH, grown=grown)
    if args.figure:
        pathlib.Path(args.figure).write_text(figure(parts), encoding="utf-8")
    return 1 if grown else 0


def held(device: str, folder: str) -> dict[str, float]:
    """What the process holds now: megabytes of memory, here and on the device, descriptors, threads, files."""
    wp.synchronize_device(device)
    on_device = wp.get_device(device)
    pool = wp.get_mempool_used_mem_current(on_device) / 2**20 if on_device.is_cuda else 0.0
    return {
        "resident": resident(),
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
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{full[0]}" height="{full[1]}" font-family="sans-serif" '
            'font-size="11">'
        ),
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


# Films


@command(
    option("--frames", type=int, default=2000, help="of a film whose memory is watched"),
    option("--size", type=int, nargs=2, default=(1920, 1080), metavar=("WIDTH", "HEIGHT")),
    option("--kinds", nargs="+", choices=FILMS, default=["mp4", "png"], help="of films that are watched"),
    JSON,
)
def films(args) -> int:
    """Memory of a long film.

        python benchmarks memory films --json docs/results/film_memory_cpu.json

    The pictures cost nothing to make, so that the encoder bounds the time. Resident memory of the process is sampled
    FILM_SAMPLES times from frame FILM_WARM on, when the encoder looks as far ahead as it does. The exit status is 1
    where the last samples lie more than FILM_GROWTH above the first.
    """
    pictures = shown_pictures(*args.size)
    memory = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in args.kinds:
            memory[kind] = watched(kind, pictures, args.frames, pathlib.Path(folder))
            first, last = ends(memory[kind]["megabytes"])
            print(f"{kind:5} {args.frames} frames: {first:.0f} to {last:.0f} MB", flush=True)
    grown = {kind: ends(found["megabytes"])[1] - ends(found["megabytes"])[0] for kind, found in memory.items()}
    size = dict(zip(("width", "height"), args.size, strict=True))
    write_results(args.json, "cpu", size=size, memory=memory, grown_megabytes=grown, limit=FILM_GROWTH)
    return 1 if max(grown.values()) > FILM_GROWTH else 0


def shown_pictures(width: int, height: int) -> list[np.ndarray]:
    """(height, width, 3) float32: a shaded ball that moves over a plain ground, with some grain on it."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    grain = np.random.default_rng(0).normal(0.0, 0.02, (height, width, 1)).astype(np.float32)
    made = []
    for index in range(PICTURES):
        u, v = (x - width * (0.4 + 0.03 * index)) / (0.4 * height), (y - height / 2) / (0.4 * height)
        inside = u * u + v * v < 1.0
        shade = np.where(inside, np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0)), 0.0)[..., None]
        picture = np.where(inside[..., None], shade * [1.0, 0.7, 0.4] + grain, 0.93).astype(np.float32)
        picture.flags.writeable = False
        made.append(picture)
    return made


def watched(kind: str, pictures: list[np.ndarray], count: int, folder: pathlib.Path) -> dict:
    """The curve of the process's memory over a film."""
    marks = {int(mark) for mark in np.linspace(min(FILM_WARM, count // 2), count - 1, FILM_SAMPLES)}
    curve: dict[str, list] = {"frames": [], "megabytes": []}

    def frames() -> Iterator[np.ndarray]:
        for index in range(count):
            if index in marks:
                curve["frames"].append(index)
                curve["megabytes"].append(resident())
            yield pictures[index % PICTURES] + np.float32(0.0)  # an array of its own, as a frame is

    begin = time.perf_counter()
    if kind == "png":
        with BackgroundWriter() as beside:
            for index, picture in enumerate(frames()):
                # the same few names again and again: what counts is memory, not the disk
                path = folder / f"frame_{index % 64}.png"
                beside.run(functools.partial(write_png, path, picture), picture.nbytes)
    else:
        film.write_film(folder / f"film.{kind}", frames())
    return curve | {"seconds": time.perf_counter() - begin, "threads": threading.active_count()}


def ends(values: list[float]) -> tuple[float, float]:
    """Means of the first and of the last values."""
    return float(np.mean(values[:ENDS])), float(np.mean(values[-ENDS:]))


# The driver and the workers of a batch


@command(option("--items", type=int, default=5000), JSON)
def batch(args) -> int:
    """Memory of the driver and of two workers of `warpcage run` over a run of many frames, each with a pose of its own.

        python benchmarks memory batch --json docs/results/batch_memory.json

    The exit status is 1 where one of them holds GROWTH megabytes more at the end than when a fifth of the items was
    made: until then caches and pools fill.
    """
    curves: dict[str, list] = {"items": [], "driver": [], "worker 0": [], "worker 1": []}
    marks = {int(mark) for mark in np.linspace(0, args.items, BATCH_SAMPLES + 1)[1:]}

    def look(state: warpcage.studio.jobs.RunProgress) -> None:
        passed = {mark for mark in marks if mark <= state.done}
        if state.stage == "make" and passed and len(Seen.newest.places) == 2:
            marks.difference_update(passed)
            curves["items"].append(state.done)
            curves["driver"].append(resident())
            for name in ("0", "1"):
                curves[f"worker {name}"].append(resident(Seen.newest.places[name]["pid"]))

    run.ProcessEngine = Seen
    with tempfile.TemporaryDirectory() as temporary:
        path = write_job(pathlib.Path(temporary), args.items)
        report = warpcage.run_jobs(path, pathlib.Path(temporary, "out"), workers=2, device="cpu", progress=look)
    assert report.complete, report
    warm = next(k for k, done in enumerate(curves["items"]) if done >= BATCH_WARM * args.items)
    grown = {name: values[-1] - values[warm] for name, values in curves.items() if name != "items"}
    for name, added in grown.items():
        print(f"{name}: {curves[name][warm]:.0f} to {curves[name][-1]:.0f} MB, {added:+.1f}")
    write_results(args.json, "cpu", seconds=report.seconds, megabytes=curves, grown=grown, limit_megabytes=GROWTH)
    return 1 if max(grown.values()) > GROWTH else 0


class Seen(ProcessEngine):
    """The engine, which exposes the processes of its workers."""

    newest: Seen

    def __init__(self, *given):
        super().__init__(*given)
        Seen.newest = self


def write_job(folder: pathlib.Path, count: int) -> pathlib.Path:
    """Frames of a field under two cages, by harmonic and by mean value coordinates, a pose each."""
    ball_field("cpu").save(folder / "ball.npz")
    for name, segments in (("coarse", 1), ("fine", 2)):
        cage = warpcage.Cage.box((-1, -1, -1), (1, 1, 1), segments=segments)
        write_twists(folder, name, cage, count // 2 + 1)
    edits = [{"cage": "coarse.obj", "coordinates": "harmonic"}, {"cage": "fine.obj", "coordinates": "mean_value"}]
    items = [
        {"id": f"f{k:06d}", "posed": f"{edits[k % 2]['cage'][:-4]}.npy#{k // 2}"} | edits[k % 2] for k in range(count)
    ]
    write_jobs(folder / "jobs.jsonl", items, defaults={"field": "ball.npz", "camera": CAMERA, "resolution": 12})
    return folder / "jobs.jsonl"
