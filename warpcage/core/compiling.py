"""What is said before kernels are compiled, which takes some seconds the first time on a machine."""

from __future__ import annotations

from collections.abc import Callable

#: Called once, before the first module of kernels of this process is compiled. None says nothing.
say: Callable[[], object] | None = None


def told() -> None:
    """Say it, if nobody has."""
    global say
    saying, say = say, None
    if saying is not None:
        saying()
