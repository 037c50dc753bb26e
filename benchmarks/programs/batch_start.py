"""What a worker of `warpcage run` does before its first frame."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import tempfile
import time

from common import CAGE, FIELD, command, eye_beside, option


@command(
    FIELD,
    CAGE,
    option("--size", type=int, default=800, help="of the frames, pixels"),
    option("--device", help="default: CUDA where there is one"),
    option("--workers", type=int, default=2, help="processes that are started"),
)
def main(args) -> None:
    """What a worker of `warpcage run` does before its first frame, and what starting processes takes.

        python benchmarks batch-start --field lego.npz --cage lego_42.obj

    The steps follow each other here, in a process that has loaded nothing; a worker hashes its field and loads kernels
    while it reads. Prints one line of JSON.
    """
    laps = Laps()
    process_steps(laps, args.workers)
    worker_steps(laps, args)
    print(json.dumps(laps.seconds))


class Laps:
    """Seconds between calls, by name."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def note(self, name: str) -> None:
        """What took from the call before until now."""
        now = time.perf_counter()
        self.seconds[name] = round(now - self._last, 4)
        self._last = now


def process_steps(laps: Laps, workers: int) -> None:
    """Start processes of workers that make nothing, as a run of several does, and end them."""
    from warpcage.studio.jobs import ItemReader, LocalHost, OutputFolder, RunnerSettings

    laps.note("import the driver")
    with tempfile.TemporaryDirectory() as temporary:
        folder = OutputFolder(temporary)
        folder.prepare()
        host = LocalHost(workers, "cpu")
        settings = RunnerSettings(temporary, ItemReader("", {}, {}), temporary, "run", "cpu", maker=Idle)
        started = [host.start(dataclasses.replace(settings, worker=str(number))) for number in range(workers)]
        for answer in [process.ask("facts") for process in started]:
            answer.result()
        laps.note("start processes")
        for process in started:
            process.kill()
            process.wait()
    laps.note("end processes")


class Idle:
    """A maker that makes nothing."""

    def __init__(self, base, out, device):
        pass


def worker_steps(laps: Laps, args) -> None:
    """All that comes before the first frame, that frame and the one after it."""
    import warp as wp

    from warpcage.studio.jobs import worker  # noqa: F401

    laps.note("import a worker")
    import warpcage
    from warpcage.core import resolve_device
    from warpcage.field import load_field
    from warpcage.render import load_pose_modules, render_modules
    from warpcage.studio.jobs.job_file import file_hash

    device = resolve_device(args.device)
    wp.zeros(1, device=device).numpy()
    laps.note("start the device")
    file_hash(pathlib.Path(args.field))
    laps.note("hash")
    held = load_field(args.field)
    laps.note("read")
    field = warpcage.VoxelField(held.bounds, held.links, held.density, held.sh, device=device, **held.options())
    wp.synchronize_device(device)
    laps.note("field to the device")
    load_pose_modules("harmonic", render_modules(device), device)
    laps.note("kernels")
    rest = warpcage.Cage.load(args.cage)
    laps.note("cage")
    deformer = warpcage.Deformer(field, rest)
    wp.synchronize_device(device)
    laps.note("deformer")
    eye, center = eye_beside(rest)
    camera = warpcage.Camera.look_at(eye, center, width=args.size, height=args.size)
    for name, degrees in (("first frame", 20), ("second frame", 30)):
        deformer.pose(rest.twist(degrees)).render(camera).rgb.sum()
        laps.note(name)
