"""SideStream: launches that may run beside others, also where they are captured in a CUDA graph."""

from __future__ import annotations

import contextlib

import warp as wp


class SideStream:
    """A second stream of a CUDA device; on a CPU launches run in the order of the program.

    `fork` orders what is launched under it after all that came before; what comes after it need not wait, until `join`.
    """

    def __init__(self, device):
        self.device = wp.get_device(device)
        self._stream = wp.Stream(self.device) if self.device.is_cuda else None

    @contextlib.contextmanager
    def fork(self):
        """Launches under this run beside those that follow."""
        if self._stream is None:
            yield
            return
        with wp.ScopedStream(self._stream, sync_enter=True):
            yield

    def join(self) -> None:
        """What follows waits for all that was forked."""
        if self._stream is not None:
            self.device.stream.wait_stream(self._stream)
