"""Words that depend on a number, or on an error."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """A number of things.

    Args:
        count: How many.
        noun: What one of them is called, whose plural ends in "s".

    Returns:
        Such as "1 frame", "2 frames".
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def system_error_line(error: object) -> str | None:
    """What an error of the system or a shortage of memory says.

    Args:
        error: The error.

    Returns:
        One line, such as "no space left on device 'film.mp4'". None for errors of other kinds.
    """
    if isinstance(error, OSError) and error.strerror:
        name = f" {str(error.filename)!r}" if error.filename else ""
        return f"{error.strerror[0].lower()}{error.strerror[1:]}{name}"
    if isinstance(error, MemoryError):
        text = " ".join(str(error).split())
        return f"not enough memory{': ' if text else ''}{text}"
    return None
