"""What the operators of this folder share: numbers of objects, streams, and arrays that go both ways."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
import warp as wp
from torch.autograd import forward_ad

from ..errors import InputError, UseError
from ..interop.numbers import number_of

#: Of a compiled function: while it is traced, a cage, a Deformer or a camera is the number that it has, with a guard.
constant_number = torch.compiler.assume_constant_result(number_of)


@contextlib.contextmanager
def in_order(tensor: torch.Tensor) -> Iterator[None]:
    """Launches of Warp come behind what torch has queued on a tensor's device, and before what it queues then."""
    if not tensor.is_cuda:
        yield
        return
    # On a stream of Warp's own: poses replay graphs, and torch's default stream is CUDA's, which cannot be captured.
    theirs = wp.stream_from_torch(torch.cuda.current_stream(tensor.device))
    own = theirs.device.stream
    with wp.ScopedDevice(theirs.device):  # threads of torch's backward passes have no CUDA context of Warp's
        own.wait_stream(theirs)
        try:
            yield
        finally:
            theirs.wait_stream(own)


def real_tensor(tensor: torch.Tensor, name: str) -> torch.Tensor:
    """A tensor of real numbers, as it is."""
    if not isinstance(tensor, torch.Tensor) or tensor.is_complex():
        given = str(tensor.dtype) if isinstance(tensor, torch.Tensor) else type(tensor).__name__
        raise InputError(f"{name} must be a tensor of real numbers, got {given}")
    # operators have no forward mode, and torch takes what passes through them for constant
    if not torch.compiler.is_compiling() and forward_ad.unpack_dual(tensor).tangent is not None:
        raise UseError("forward derivatives (jvp) do not pass through warpcage.torch: take backward ones (vjp)")
    return tensor


def single(tensor: torch.Tensor, name: str) -> torch.Tensor:
    """A tensor of real numbers as single floats, as kernels take it; gradients pass."""
    return real_tensor(tensor, name).to(torch.float32)


def host(tensor: torch.Tensor) -> np.ndarray:
    """A small tensor as NumPy, float64."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def tensor_of(array: Any) -> torch.Tensor:
    """A tensor over the memory of a Warp array, (n, 3) for vec3."""
    return wp.to_torch(array, requires_grad=False)


def like(slopes: torch.Tensor, given: torch.Tensor | None) -> torch.Tensor | None:
    """Slopes of an argument on its device and of its numbers, none of one that was left out."""
    return None if given is None else slopes.to(given.device, given.dtype)
