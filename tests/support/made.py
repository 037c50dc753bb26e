"""What takes long to make and many tests only need one of: made once, under a lock, and kept as a file between runs."""

import functools
import hashlib
import pathlib

import filelock

ROOT = pathlib.Path(__file__).resolve().parents[2]
KEPT = 4  # files of one name, of the newest sources


@functools.cache
def key_of_sources():
    """A name for the present state of all that makes fields, cages and pictures."""
    found = hashlib.sha256()
    for folder in ("warpcage", "kernels", "tests/support"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".h") and "__pycache__" not in path.parts:
                found.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:16]


def made_once(config, name, make):
    """The path of a file that `make(path)` writes unless one of these sources is there.

    config: pytest's, whose cache keeps the file. name: Of the file, with its ending.
    """
    stem, _, ending = name.partition(".")
    folder = config.cache.mkdir("made")
    path = folder / f"{stem}-{key_of_sources()}.{ending}"
    with filelock.FileLock(folder / f"{name}.lock"):
        if not path.is_file():
            for old in sorted(folder.glob(f"{stem}-*.{ending}"), key=lambda each: each.stat().st_mtime)[: 1 - KEPT]:
                old.unlink()
            unfinished = folder / f"unfinished.{ending}"
            make(unfinished)
            unfinished.rename(path)
    return path
