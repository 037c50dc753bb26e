"""Choose a Warp device, and launch kernels on all cores of the CPU."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import warp as wp

from .locks import device_turn
from .modules import Kernel, require_loaded, start_warp
from .threads import cpu_threads, run_parts

#: Work of the first part of a launch on the CPU, in steps of `launch`: some hundredths of a second where it is known.
FIRST_WORK = 1 << 20

#: Steps that an item is taken for where nobody knows.
USUAL_WORK = 16


def resolve_device(device: wp.DeviceLike = None) -> wp.Device:
    """The Warp device of a name.

    Args:
        device: A Warp device or its name. None is the first CUDA device, or the CPU where there is none.

    Returns:
        The device.

    Raises:
        ValueError: If the machine has no such device.
    """
    if isinstance(device, wp.Device):
        return device
    start_warp()
    if device is None:
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    try:
        if str(device).startswith("cuda") and not wp.is_cuda_available():
            raise ValueError("no CUDA")  # Warp would look for its current context, and print that there is no driver
        return wp.get_device(str(device))
    except Exception as error:
        present = ", ".join(found.alias for found in wp.get_devices())
        raise ValueError(f"device {str(device)!r} is not there: this machine has {present}") from error


def launch(
    kernel: Kernel,
    count: int,
    inputs: Sequence[Any],
    outputs: Iterable[Any] = (),
    *,
    device: wp.DeviceLike,
    threads: int | None = None,
    block_dim: int | None = None,
    work: float = USUAL_WORK,
) -> None:
    """Launch a one-dimensional kernel whose first parameter is `first`, the index of this launch's first item.

    On CUDA it is one launch with `first` = 0. On the CPU the items are cut into parts that run on several threads, so
    outputs of different items must be disjoint: no atomics across items there. Parts last a fraction of a second, so
    that an interrupt acts soon. Any thread may launch.

    Args:
        kernel: The kernel.
        count: Number of items. Nothing is launched for 0.
        inputs: Arguments of the kernel after `first`.
        outputs: Arguments of the kernel after those.
        device: Warp device that holds them.
        threads: Threads on the CPU. None is `cpu_threads()`.
        block_dim: Threads per block on CUDA. None is what the kernel's module names, as a module is compiled once more
            for each other number.
        work: Steps that an item may take, such as samples along a ray, where it may be many. Each should last about
            0.1 us or less.
    """
    assert isinstance(kernel, wp.Kernel)
    device = wp.get_device(device)
    if count <= 0:
        return
    block_dim = module_block_dim(kernel) if block_dim is None else block_dim
    require_loaded(kernel, device, block_dim)

    outputs = list(outputs)

    def run(begin: int, end: int) -> None:
        arguments = [begin, *inputs]
        wp.launch(kernel, dim=end - begin, inputs=arguments, outputs=outputs, device=device, block_dim=block_dim)

    if not device.is_cpu:
        with device_turn(device):
            run(0, count)
        return
    threads = cpu_threads() if threads is None else threads
    first = max(1, int(FIRST_WORK / max(work, 1.0)))
    if count < 2 * threads:
        threads = 1
    if threads <= 1 and count <= first:
        run(0, count)
    else:
        run_parts(run, count, threads, first)


class RepeatedLaunch:
    """A kernel that frames launch one after the other with mostly the same arguments.

    To pack all arguments takes the host several times as long as the launch itself. So CUDA launches are recorded: a
    later one sets those that have become other objects, and what a struct holds may change. The arguments of the last
    one stay alive, but for those that are said to pass. On a CPU it is `launch`.

    Args:
        kernel: The kernel.
        device: Warp device.
    """

    def __init__(self, kernel: Kernel, device: wp.DeviceLike):
        self._kernel, self._device = kernel, wp.get_device(device)
        self._count, self._arguments, self._recorded = 0, [], None

    def __call__(
        self,
        count: int,
        inputs: Sequence[Any],
        outputs: Iterable[Any] = (),
        *,
        passing: int = 0,
        stream: wp.Stream | None = None,
        threads: int | None = None,
        work: float = USUAL_WORK,
    ) -> None:
        """Launch it.

        Args:
            count: Number of items. Nothing is launched for 0.
            inputs: Arguments of the kernel after `first`.
            outputs: Arguments of the kernel after those.
            passing: How many of the last arguments are not kept alive: what one frame alone has.
            stream: Of CUDA. None is the current one.
            threads: As `launch` has it.
            work: As `launch` has it.
        """
        if self._device.is_cpu:
            launch(self._kernel, count, inputs, outputs, device=self._device, threads=threads, work=work)
        elif count > 0:
            with device_turn(self._device):
                recorded = self._command(count, [0, *inputs, *outputs])
                recorded.launch(stream)
                for index in range(len(self._arguments) - passing, len(self._arguments)):
                    self._arguments[index] = recorded.fwd_args[index] = None
                self._recorded = recorded

    def _command(self, count: int, arguments: list[Any]) -> Any:
        """The recorded launch with these arguments."""
        recorded, self._recorded = self._recorded, None  # an interrupt leaves none that is half set
        before, self._arguments = self._arguments, arguments
        if recorded is None:
            self._count, block_dim = count, module_block_dim(self._kernel)
            require_loaded(self._kernel, self._device, block_dim)
            options: dict[str, Any] = {"device": self._device, "block_dim": block_dim, "record_cmd": True}
            return wp.launch(self._kernel, dim=count, inputs=arguments, **options)
        for index, (argument, last) in enumerate(zip(arguments, before, strict=True)):
            if argument is not last:
                recorded.set_param_at_index(index, argument)
        if count != self._count:
            self._count = count
            recorded.set_dim(count)
        return recorded


class RepeatedLaunches:
    """The launches that an owner makes once a pose or a frame, each a RepeatedLaunch.

    Args:
        device: Warp device.
    """

    def __init__(self, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        self._launches: dict[tuple[Kernel, int], RepeatedLaunch] = {}

    def __call__(
        self,
        kernel: Kernel,
        count: int,
        inputs: Sequence[Any],
        outputs: Iterable[Any] = (),
        *,
        number: int = 0,
        **how: Any,
    ) -> None:
        """Launch a kernel.

        Args:
            kernel: The kernel.
            count: Number of items.
            inputs: Arguments of the kernel after `first`.
            outputs: Arguments of the kernel after those.
            number: Of the launch, among those of the same kernel.
            **how: As RepeatedLaunch has it.
        """
        key = kernel, number
        if key not in self._launches:
            self._launches[key] = RepeatedLaunch(kernel, self._device)
        self._launches[key](count, inputs, outputs, **how)


def lane_count(device: wp.DeviceLike) -> int:
    """Items that share a piece of work in kernels written for a group of lanes (kernels/core/lanes.py).

    Args:
        device: Warp device.

    Returns:
        1 on the CPU, else 32.
    """
    return 1 if wp.get_device(device).is_cpu else 32


def module_block_dim(kernel: Kernel) -> int:
    """Threads per block that a kernel's module is meant for.

    Args:
        kernel: The kernel.

    Returns:
        The option block_dim of its module, 256 where it names none.
    """
    assert isinstance(kernel, wp.Kernel)
    return kernel.module.options["block_dim"]
