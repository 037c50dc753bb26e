"""Progress of the steps of a capture."""

from __future__ import annotations

from typing import Any


def bar(total: int | None, step: str, shown: bool, *, done: int = 0) -> Any:
    """A bar for one step, as a context; its `update(count)` moves it on.
    total: None is not known; done: items that an earlier run did."""
    from tqdm import tqdm

    return tqdm(total=total, initial=done, desc=step, disable=not shown)
