"""A number that a device tells the host, which need not wait for what is launched afterwards."""

from __future__ import annotations

import warp as wp


class HostFlag:
    """One number that kernels set and the host waits for."""

    def __init__(self, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        # (1,) int32, for kernels
        self.array = wp.zeros(1, dtype=wp.int32, device=self._device)
        self._host = wp.zeros(1, dtype=wp.int32, device="cpu", pinned=True) if self._device.is_cuda else self.array
        self._sent = wp.Event(self._device) if self._device.is_cuda else None

    def clear(self) -> None:
        """Set it to 0, after all that was launched."""
        self.array.zero_()

    def send(self) -> None:
        """Let the host have what the kernels launched up to now leave."""
        if self._sent is not None:
            wp.copy(self._host, self.array)
            wp.record_event(self._sent)

    def wait(self) -> int:
        """Wait for what was sent last, and not for what was launched afterwards."""
        if self._sent is not None:
            wp.synchronize_event(self._sent)
        return int(self._host.numpy()[0])
