"""A worker: makes items one after another, each whole or not at all, and keeps what the next ones need."""

from __future__ import annotations

import contextlib
import os
import pathlib
import uuid
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import warp as wp

from ..core.devices import resolve_device
from .frames import FrameMaker, Writer
from .items import EvaluateItem, FitItem, FrameItem, Item
from .references import References

#: Folder of a run in which files stand until they are whole. What is left there belongs to nobody once no worker runs.
PARTS = ".warpcage/parts"

#: Threads that encode pictures, and frames that may wait for them: so many frames are in main memory at most.
ENCODERS, MOST_WAITING = 4, 8


class Worker:
    """Makes items. One thread at a time may use it.

    Args:
        base: Folder that paths in items are relative to.
        out: Folder that outputs are relative to; it is made.
        device: Warp device. None is CUDA where there is one.
        memory: Bytes that fields and deformers may take. None is half of what is free on the device.
        encoders: Threads that encode pictures while the next ones are rendered.

    Attributes:
        out: The folder of outputs.
        device: The device.
        frames: What renders frames; its `counts` say how often something was made anew.
    """

    def __init__(
        self,
        base: str | os.PathLike,
        out: str | os.PathLike,
        device: wp.DeviceLike = None,
        *,
        memory: int | None = None,
        encoders: int = ENCODERS,
    ):
        self.out, self.device = pathlib.Path(out), resolve_device(device)
        self.references = References(base)
        self.frames = FrameMaker(self.references, self.device, memory)
        self._pool = ThreadPoolExecutor(encoders, "encoder")
        self._waiting: list[Future[dict[str, int]]] = []

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish what is being written, and let go of all that is loaded."""
        self._pool.shutdown()
        self.frames.forget()

    def run(self, item: Item, out: str | os.PathLike | None = None) -> dict[str, int]:
        """Make an item.

        Args:
            item: The item.
            out: Folder of its outputs. None is that of the worker.

        Returns:
            Bytes of its outputs, by their paths.

        Raises:
            FileNotFoundError: For a file that is not there.
            ValueError: For what cannot be used.
            OSError: Where outputs cannot be written; none of them is there then.
        """
        return self.submit(item, out).result()

    def submit(self, item: Item, out: str | os.PathLike | None = None) -> Future[dict[str, int]]:
        """Make an item; its outputs are encoded and written in another thread, while the next item is rendered.

        At most MOST_WAITING items wait for that: this waits where there are more.

        Args:
            item: The item.
            out: Folder of its outputs. None is that of the worker.

        Returns:
            Becomes the bytes of its outputs by their paths once they are in their places, or its error.
        """
        self._waiting = [each for each in self._waiting if not each.done()]
        while len(self._waiting) >= MOST_WAITING:
            self._waiting.pop(0).exception()
        done: Future[dict[str, int]] = Future()
        try:
            writers = self._made(item)
        except Exception as error:
            done.set_exception(error)
            return done
        folder = self.out if out is None else pathlib.Path(out)
        done = self._pool.submit(write_outputs, writers, folder, self.out / PARTS)
        self._waiting.append(done)
        return done

    def _made(self, item: Item) -> dict[str, Writer]:
        if isinstance(item, FrameItem):
            return self.frames.make(item)
        assert isinstance(item, FitItem | EvaluateItem)
        raise NotImplementedError(f"items of kind {item.kind!r}")


def write_outputs(writers: Mapping[str, Writer], out: pathlib.Path, parts: pathlib.Path) -> dict[str, int]:
    """Write files, all of them or none.

    They are written in a folder of their own, and put into their places when all are whole.

    Args:
        writers: What writes each, by its path below `out`.
        out: The folder.
        parts: Folder for files that are not whole yet, on the same file system.

    Returns:
        Bytes of the files, by their paths.

    Raises:
        OSError: Where they cannot be written.
    """
    sizes: dict[str, int] = {}
    with _part_names(writers, parts) as names:
        for path, write in writers.items():
            write(names[path])
            sizes[path] = names[path].stat().st_size
        for path in writers:
            (out / path).parent.mkdir(parents=True, exist_ok=True)
        for path in writers:
            os.replace(names[path], out / path)
    return sizes


@contextlib.contextmanager
def _part_names(paths: Mapping[str, Writer], parts: pathlib.Path) -> Iterator[dict[str, pathlib.Path]]:
    """A file's name in `parts` for each path, with its ending; what is still there at the end is removed."""
    parts.mkdir(parents=True, exist_ok=True)
    stem = uuid.uuid4().hex
    names = {path: parts / f"{stem}-{number}{pathlib.PurePosixPath(path).suffix}" for number, path in enumerate(paths)}
    try:
        yield names
    finally:
        for name in names.values():
            with contextlib.suppress(OSError):
                name.unlink()
