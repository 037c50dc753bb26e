"""Words that depend on a number."""

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
