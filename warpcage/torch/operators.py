"""What the operators of this folder share: numbers of objects, streams, and arrays that go both ways."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import torch
import warp as wp

from ..interop.numbers import number_of

#: Of a compiled function: while it is traced, a cage, a Deformer or a camera is the number that it has, with a guard.
constant_number = torch.compiler.assume_constant_result(number_of)


def on_stream(tensor: torch.Tensor) -> contextlib.AbstractContextManager[Any]:
    """The stream on which torch works on a tensor's device, for launches of Warp. Each waits for the other."""
    if not tensor.is_cuda:
        return contextlib.nullcontext()
    stream = wp.stream_from_torch(torch.cuda.current_stream(tensor.device))
    return wp.ScopedStream(stream, sync_enter=True, sync_exit=True)


def single(tensor: torch.Tensor) -> torch.Tensor:
    """A tensor as single floats, as kernels take it; gradients pass."""
    return tensor.to(torch.float32)


def host(tensor: torch.Tensor) -> np.ndarray:
    """A small tensor as NumPy, float64."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def tensor_of(array: Any) -> torch.Tensor:
    """A tensor over the memory of a Warp array, (n, 3) for vec3."""
    return wp.to_torch(array, requires_grad=False)


def like(slopes: torch.Tensor, given: torch.Tensor | None) -> torch.Tensor | None:
    """Slopes of an argument on its device and of its numbers, none of one that was left out."""
    return None if given is None else slopes.to(given.device, given.dtype)
