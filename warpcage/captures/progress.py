"""Progress of the steps of a capture."""

from __future__ import annotations

from typing import Any


def bar(total: int | None, step: str, shown: bool, *, done: int = 0) -> Any:
    """A bar for one step, as a context.

    Args:
        total: Items in all. None is not known.
        step: What it does, in a word.
        shown: Whether it is shown at all.
        done: Items that an earlier run did.

    Returns:
        The bar, whose `update(count)` moves it on.
    """
    from tqdm import tqdm

    return tqdm(total=total, initial=done, desc=step, disable=not shown)
