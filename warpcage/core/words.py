"""Words that depend on a number, or on an error."""

from __future__ import annotations


def counted(count: int, noun: str, plural: str = "") -> str:
    """A number of things.

    Args:
        count: How many.
        noun: What one of them is called.
        plural: What several are called. Empty adds an "s".

    Returns:
        Such as "1 frame", "2 frames".
    """
    return f"{count} {agreed(count, noun, plural or f'{noun}s')}"


def agreed(count: int, one: str, several: str) -> str:
    """A word as a number has it.

    Args:
        count: How many.
        one: The word of one thing, such as "is".
        several: That of none or several, such as "are".

    Returns:
        One of both.
    """
    return one if count == 1 else several


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
