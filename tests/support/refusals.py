"""Calls that are refused: in one line of an error of the package, for little memory."""

import re
import tracemalloc

import pytest

import warpcage


def peak_of(action, most=float("inf")):
    """Most bytes that Python and NumPy held during an action, beyond those held before it, and what it returned."""
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    try:
        result = action()
    finally:
        peak = tracemalloc.get_traced_memory()[1] - before
        tracemalloc.stop()
        assert peak < most
    return peak, result


def refused(action, *parts, error=ValueError, match="", most=None):
    """The action is refused in one line that holds all the parts and a pattern, and takes at most so many bytes.
    Returns the line."""
    with pytest.raises(error) as caught:
        if most is None:
            action()
        else:
            peak_of(action, most)
    message = str(caught.value)
    assert isinstance(caught.value, warpcage.Error) and message and "\n" not in message, message
    assert all(part in message for part in parts) and re.search(match, message), message
    return message
