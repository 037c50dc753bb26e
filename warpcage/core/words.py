"""Words that depend on a number, or on an error."""

from __future__ import annotations


def counted(count: int, noun: str, plural: str = "") -> str:
    """A number of things, such as "1 frame" or "2 frames"; an empty plural adds an "s"."""
    return f"{count} {agreed(count, noun, plural or f'{noun}s')}"


def agreed(count: int, one: str, several: str) -> str:
    """The word of one thing, such as "is", or that of none or several, such as "are"."""
    return one if count == 1 else several


def system_error_line(error: object) -> str | None:
    """One line for an error of the system or a shortage of memory, such as "no space left on device 'film.mp4'"; else
    None."""
    if isinstance(error, OSError) and error.strerror:
        name = f" {str(error.filename)!r}" if error.filename else ""
        return f"{error.strerror[0].lower()}{error.strerror[1:]}{name}"
    if isinstance(error, MemoryError):
        text = " ".join(str(error).split())
        return f"not enough memory{': ' if text else ''}{text}"
    return None
