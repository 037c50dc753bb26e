"""Where a capture keeps what it has done, so that a killed one continues and a failed one leaves nothing."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import shutil
from types import TracebackType

from ..core.files import atomic_path

#: Counts up when what the folder holds changes its meaning.
LAYOUT = 1


class WorkFolder:
    """A hidden folder beside the output, a context; another job (what is captured and how, for JSON) starts anew."""

    # It goes when the capture is done, and when its input cannot be used. What ends the capture in another way, a kill
    # or an interrupt or a full disk, leaves it there, and the same capture continues in it.

    def __init__(self, output: pathlib.Path, job: dict):
        self.path = output.with_name(f".{output.name}.capture")
        self._job = json.loads(json.dumps({"layout": LAYOUT, **job}))

    def __enter__(self) -> pathlib.Path:
        note = self.path / "job.json"
        self._made = [parent for parent in self.path.parents if not parent.exists()]  # the nearest first
        try:
            same = json.loads(note.read_text("utf-8")) == self._job
        except (OSError, ValueError):
            same = False
        if not same:
            shutil.rmtree(self.path, ignore_errors=True)
            self.path.mkdir(parents=True)
            with atomic_path(note) as temporary:
                temporary.write_text(json.dumps(self._job), encoding="utf-8")
        return self.path

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, ValueError | FileNotFoundError):
            shutil.rmtree(self.path, ignore_errors=True)
        if kind is not None:
            with contextlib.suppress(OSError):  # one that holds something
                for parent in self._made:
                    parent.rmdir()


def require_new_folder(path: pathlib.Path) -> None:
    """Refuse an output that is there already, or that cannot be made."""
    if path.is_dir():
        if any(path.iterdir()):
            raise ValueError(f"output folder {str(path)!r} is there and not empty: give a new one, or remove it")
    elif path.exists() or path.is_symlink():
        raise ValueError(f"output folder {str(path)!r} is a file: give a new one, or remove it")
    for parent in path.absolute().parents:
        if parent.exists():
            if not parent.is_dir():
                raise ValueError(f"{str(path)!r} cannot be written: {str(parent)!r} is not a folder")
            return


def publish(new: pathlib.Path, output: pathlib.Path) -> None:
    """Put a finished folder in its place, where nothing is, or an empty folder."""
    if output.is_dir():
        output.rmdir()  # empty, or this fails
    os.replace(new, output)
