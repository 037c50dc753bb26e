"""Lines of numbers in a mesh file, with errors that name the file and the line."""

from __future__ import annotations

import pathlib

import numpy as np


def text_lines(path: pathlib.Path, data: bytes | None = None, first: int = 1):
    """Number and words of each line that holds something, comments left out; a backslash continues a line; a byte
    order mark, as some editors write it, is none of them."""
    text = (path.read_bytes() if data is None else data).decode("utf-8-sig", errors="replace")
    held = ""
    for number, line in enumerate(text.splitlines(), start=first):
        line = held + line.split("#", 1)[0].rstrip()
        if line.endswith("\\"):
            held = line[:-1] + " "
            continue
        held = ""
        words = line.split()
        if words:
            yield number, words


def floats(words, path, line) -> list[float]:
    """Words as finite numbers."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise ValueError(f"{path}:{line}: numbers expected, got {' '.join(words)!r}") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{path}:{line}: finite numbers expected, got {' '.join(words)!r}")
    return values


def whole(words, path, line) -> list[int]:
    """Words as whole numbers."""
    try:
        return [int(word) for word in words]
    except ValueError:
        raise ValueError(f"{path}:{line}: whole numbers expected, got {' '.join(words)!r}") from None


def point(words, path, line) -> list[float]:
    """The first three words as numbers."""
    if len(words) < 3:
        raise ValueError(f"{path}:{line}: a vertex needs 3 numbers, got {len(words)}")
    return floats(words[:3], path, line)
