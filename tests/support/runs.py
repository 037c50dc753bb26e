"""Files for tests of the command line and of jobs, how both are run, what came of a run."""

import json
import pathlib
import sys

import imageio.v3 as iio
import numpy as np

from warpcage import Cage, VoxelField, run_jobs
from warpcage.demo import write_brick_scene
from warpcage.studio.cli import main
from warpcage.studio.jobs import write_jobs

#: Where helpers are, for processes that tests start.
SUPPORT = str(pathlib.Path(__file__).parent)

DEFORMED = ("--cage", "@cage.obj", "--posed", "@posed.obj")
SMALL = ("--size", "40", "--coordinates", "mean_value", "--resolution", "24")


def write_files(folder):
    """A ball as field and mesh, a box around it at rest and posed, a small scene."""
    x, y, z = np.meshgrid(*[(np.arange(24) + 0.5) / 12 - 1] * 3, indexing="ij")
    density = np.where(x**2 + y**2 + z**2 < 0.3, 40.0, 0.0)
    sh = np.zeros((24, 24, 24, 9, 3))
    sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]]).save(folder / "ball.npz")
    cage = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7), segments=2)
    cage.save(folder / "cage.obj")
    cage.bend(40, axis="x", towards="z").save(folder / "posed.obj")
    Cage(cage.vertices, cage.faces[1:]).save(folder / "open.obj")
    Cage(cage.vertices, cage.faces[:, ::-1]).save(folder / "inward.obj")
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7)).save(folder / "other.obj")
    Cage(cage.vertices, np.roll(cage.faces, 1, axis=0)).save(folder / "shuffled.obj")
    (folder / "text.txt").write_text("text")
    (folder / "broken.npz").write_bytes(b"no archive")
    (folder / "broken.obj").write_text("v 0 0 zero\n")
    (folder / "empty").mkdir()
    write_brick_scene(folder / "scene", train_views=6, test_views=2, size=24)
    return folder


def run(files, *argv):
    """The exit status of a command; @name is a file of the folder."""
    return main([str(each).replace("@", f"{files}/") for each in argv])


def succeed(files, *argv):
    assert run(files, *argv) == 0


CAMERA = {"eye": [2.5, 1.2, 1.0], "target": [0, 0, 0], "width": 24, "height": 20}
RECORDS = {"kind": "webdataset", "items_per_shard": 5}
DEFAULTS = {"field": "ball.npz", "cage": "cage.obj", "camera": CAMERA, "coordinates": "mean_value", "resolution": 12}


def write_frames(folder, count, name="jobs.jsonl", *, changes=None, **defaults):
    """A job of frames, a pose each; changes: other keys of some, by their number."""
    if not (folder / "ball.npz").exists():
        folder.mkdir(exist_ok=True)
        write_files(folder)
    rest = Cage.load(folder / "cage.obj")
    bends = [rest.bend(40 * place / count, axis="x", towards="z").vertices for place in range(count)]
    poses = f"{pathlib.Path(name).stem}.npy"
    np.save(folder / poses, np.stack(bends))
    items = [{"id": f"shot/f{place:04d}", "posed": f"{poses}#{place}"} for place in range(count)]
    for place, keys in (changes or {}).items():
        items[place] |= keys
    write_jobs(folder / name, items, defaults=DEFAULTS | defaults)
    return folder / name


def write_records(folder, count, records, name="records.jsonl", **options):
    path = write_frames(folder, count, name, **options)
    lines = path.read_text().splitlines()
    lines[0] = json.dumps(json.loads(lines[0]) | {"records": records})
    path.write_text("\n".join(lines) + "\n")
    return path


def run_with(path, out, maker=None, workers=1, retries=2, **options):
    """A run, by makers of items that may fail. Without a maker it is that of users."""
    return run_jobs(path, out, workers=workers, device="cpu", retries=retries, make=maker, **options)


def records(out):
    """The records of a manifest, and that each item is there once."""
    lines = [json.loads(line) for line in (out / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]
    found = {record["id"]: record for record in lines}
    assert len(found) == len(lines), "an item is in the manifest twice"
    return found


def pictures(out):
    """The bytes of all files but the run's own."""
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and ".warpcage" not in path.parts]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files if path.name != "manifest.jsonl"}


def require_same_film(one, other):
    """The same file, or for .mp4 the same pictures but for what x264 loses."""
    # It codes equal frames in another way now and then: small ones are 38 dB apart then, neighbouring frames 27 dB.
    if one.suffix != ".mp4":
        assert one.read_bytes() == other.read_bytes()
        return
    pictures, others = (iio.imread(path, plugin="pyav").astype(float) for path in (one, other))
    assert pictures.shape == others.shape
    assert ((pictures - others) ** 2).mean(axis=(1, 2, 3)).max() < 26.0  # 34 dB
    assert iio.immeta(one, plugin="pyav")["fps"] == iio.immeta(other, plugin="pyav")["fps"]


def left_over(out):
    """What a run left of its own besides its locks."""
    own = [path.name for path in (out / ".warpcage").rglob("*") if path.is_file()]
    return sorted(set(own) - {"driver.lock", "workers.lock"}) + [path.name for path in out.glob(".*-*")]


def without(entry, *names):
    return {name: value for name, value in entry.items() if name not in names}


def command(*argv):
    """A command line of `warpcage`, in a process of its own."""
    return [sys.executable, "-m", "warpcage", *map(str, argv)]
