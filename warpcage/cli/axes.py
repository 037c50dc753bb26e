"""Words for directions as arguments."""

from __future__ import annotations

import argparse

from ..cage.axes import AXIS_WORDS, is_axis


def axis_word(text: str) -> str:
    """A word for a direction, as an argument. Raises argparse.ArgumentTypeError for others."""
    if not is_axis(text):
        raise argparse.ArgumentTypeError(f"must be {AXIS_WORDS}, got {text!r}")
    return text
