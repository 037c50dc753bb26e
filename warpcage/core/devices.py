"""Warp devices: which one, launches on all cores of the CPU, flags, textures, memory kept for the next frame."""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NoReturn

import warp as wp

from ..errors import InputError, UseError
from .modules import Kernel, require_loaded, start_warp
from .threads import collector_lock, cpu_threads, device_turn, run_parts

#: Work of the first part of a launch on the CPU, in steps of `launch`: some hundredths of a second where it is known.
FIRST_WORK = 1 << 20

#: Steps of an item where `work` is not given.
DEFAULT_WORK = 16

_records: tuple[list[str], ...] = ()  # of `recorded_launches`; threads replace the tuple as a whole
_records_change = threading.Lock()


def resolve_device(device: wp.DeviceLike = None) -> wp.Device:
    """The Warp device of a name; None is the first CUDA device, or the CPU where there is none."""
    if isinstance(device, wp.Device):
        return device
    start_warp()
    if device is None:
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    try:
        if str(device).startswith("cuda") and not wp.is_cuda_available():
            raise InputError("no CUDA")  # Warp would look for its current context, and print that there is no driver
        return wp.get_device(str(device))
    except Exception as error:
        present = ", ".join(found.alias for found in wp.get_devices())
        raise InputError(f"device {str(device)!r} is not there: this machine has {present}") from error


def launch(
    kernel: Kernel,
    count: int,
    inputs: Sequence[Any],
    outputs: Iterable[Any] = (),
    *,
    device: wp.DeviceLike,
    threads: int | None = None,
    block_dim: int | None = None,
    work: float = DEFAULT_WORK,
) -> None:
    """Launch a one-dimensional kernel whose first parameter is `first`, the index of this launch's first item.
    On the CPU outputs of items must be disjoint: no atomics. `work`: steps an item may take, each 0.1 us or less."""
    # One launch with `first` = 0 on CUDA; on the CPU parts run on several threads. Any thread may launch.
    assert isinstance(kernel, wp.Kernel)
    device = wp.get_device(device)
    if count <= 0:
        return
    block_dim = module_block_dim(kernel) if block_dim is None else block_dim  # each other number compiles anew
    require_loaded(kernel, device, block_dim)

    _record(kernel)
    outputs = list(outputs)

    def run(begin: int, end: int) -> None:
        arguments = [begin, *inputs]
        launch_off_tape(kernel, end - begin, arguments, outputs, device=device, block_dim=block_dim)

    if not device.is_cpu:
        with device_turn(device):
            run(0, count)
        return
    threads = cpu_threads() if threads is None else threads
    first = max(1, int(FIRST_WORK / max(work, 1.0)))  # parts are short, so that an interrupt acts soon
    if count < 2 * threads:
        threads = 1
    if threads <= 1 and count <= first:
        run(0, count)
    else:
        run_parts(run, count, threads, first)


def launch_off_tape(
    kernel: Kernel, count: int, inputs: Sequence[Any], outputs: Sequence[Any] = (), **options: Any
) -> Any:
    """`wp.launch` that no wp.Tape of a caller records; `options` are more of its own. All launches go through here."""
    # A tape would differentiate kernels that have no backward pass, and fails at structs with an array left out.
    return wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, record_tape=False, **options)


@contextlib.contextmanager
def captured(device: wp.Device, **options: Any) -> Iterator[wp.ScopedCapture]:
    """`wp.ScopedCapture`, which no garbage collection of another thread breaks."""
    with collector_lock(), wp.ScopedCapture(device, **options) as capture:
        yield capture


class RecordedLaunch:
    """A kernel that frames launch one after the other with mostly the same arguments; on a CPU it is `launch`, but for
    short launches on one thread."""

    # To pack all arguments takes the host several times as long as the launch. So launches are recorded: later ones
    # set what became other objects (structs may change inside). Arguments stay alive, but for those said to pass.

    def __init__(self, kernel: Kernel, device: wp.DeviceLike):
        self.kernel, self._device = kernel, wp.get_device(device)
        self._count, self._arguments, self._recorded = 0, [], None

    def __call__(
        self,
        count: int,
        inputs: Sequence[Any],
        outputs: Iterable[Any] = (),
        *,
        transient: int = 0,
        stream: wp.Stream | None = None,
        threads: int | None = None,
        work: float = DEFAULT_WORK,
    ) -> None:
        """Launch it; the last `transient` arguments are not kept alive: what one frame alone has."""
        if self._device.is_cpu and (threads != 1 or count * work > FIRST_WORK):
            launch(self.kernel, count, inputs, outputs, device=self._device, threads=threads, work=work)
        elif count > 0:
            with device_turn(self._device):
                recorded = self._command(count, [0, *inputs, *outputs])
                _record(self.kernel)
                recorded.launch(stream)
                for index in range(len(self._arguments) - transient, len(self._arguments)):
                    self._arguments[index] = recorded.fwd_args[index] = None
                self._recorded = recorded

    def _command(self, count: int, arguments: list[Any]) -> Any:
        """The recorded launch with these arguments."""
        recorded, self._recorded = self._recorded, None  # an interrupt leaves none that is half set
        before, self._arguments = self._arguments, arguments
        if recorded is None:
            self._count, block_dim = count, module_block_dim(self.kernel)
            require_loaded(self.kernel, self._device, block_dim)
            options: dict[str, Any] = {"device": self._device, "block_dim": block_dim, "record_cmd": True}
            return launch_off_tape(self.kernel, count, arguments, **options)
        for index, (argument, last) in enumerate(zip(arguments, before, strict=True)):
            if argument is not last:
                recorded.set_param_at_index(index, argument)
        if count != self._count:
            self._count = count
            recorded.set_dim(count)
        return recorded


class RecordedLaunches:
    """The launches that an owner makes once a pose or a frame, each a RecordedLaunch."""

    def __init__(self, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        self._launches: dict[tuple[Kernel, int], RecordedLaunch] = {}

    def __call__(
        self,
        kernel: Kernel,
        count: int,
        inputs: Sequence[Any],
        outputs: Iterable[Any] = (),
        *,
        number: int = 0,
        **options: Any,
    ) -> None:
        """Launch a kernel; `number`: of launches of the same kernel; `options`: of RecordedLaunch."""
        key = kernel, number
        if key not in self._launches:
            self._launches[key] = RecordedLaunch(kernel, self._device)
        self._launches[key](count, inputs, outputs, **options)


@contextlib.contextmanager
def recorded_launches() -> Iterator[list[str]]:
    """The labels of the kernels that any thread launches meanwhile, in their order; without what graphs replay."""
    global _records
    labels: list[str] = []
    with _records_change:
        _records = (*_records, labels)
    try:
        yield labels
    finally:
        with _records_change:
            _records = tuple(each for each in _records if each is not labels)


def kernel_label(kernel: Kernel) -> str:
    """A kernel's file with its name or that of its variant, such as "tile_order.count_tiles" or "views.shaded+part"."""
    assert isinstance(kernel, wp.Kernel)
    module = kernel.module.name
    has_variants = module != kernel.func.__module__
    return ".".join((module if has_variants else f"{module}.{kernel.key}").split(".")[-2:])


def _record(kernel: Kernel) -> None:
    for labels in _records:
        labels.append(kernel_label(kernel))


def lane_count(device: wp.DeviceLike) -> int:
    """Items that share a piece of work in kernels for groups of lanes (kernels/core/lanes): 1 on the CPU, else 32."""
    return 1 if wp.get_device(device).is_cpu else 32


def octet_items(device: wp.DeviceLike, pieces: int) -> int:
    """Items of a kernel that gives each piece of work an octet of lanes (kernels/core/lanes), in whole warps."""
    return pieces if wp.get_device(device).is_cpu else -(-pieces // 4) * 32


def module_block_dim(kernel: Kernel) -> int:
    """Threads per block that a kernel's module is meant for: its option block_dim, 256 where it names none."""
    assert isinstance(kernel, wp.Kernel)
    return kernel.module.options["block_dim"]


class HeldOnDevice:
    """What holds memory of a device, and is not pickled or copied as other objects are."""

    _elsewhere = "make one in each of them"  # how other processes come to have it

    def __reduce__(self) -> NoReturn:
        name = type(self).__name__
        raise UseError(f"a {name} is held on a device and not copied between processes: {self._elsewhere}")


class HostFlag:
    """One number that kernels set and the host waits for."""

    def __init__(self, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        self.array = wp.zeros(1, dtype=wp.int32, device=self._device)  # (1,) int32, for kernels
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


#: Frames of one size that may be dropped and made again without the driver.
SPARE_FRAMES = 2

#: Bytes that are kept at least, as a pool reserves memory in large pieces.
MIN_SPARE = 64 << 20

#: The release threshold that was set last for each CUDA device, by ordinal.
release_thresholds: dict[int, int] = {}


class SpareMemory:
    """What one owner of frames lets the pool of its device keep."""

    # Whenever the host waits for a GPU, its pool gives the driver what it holds beyond its release threshold, by
    # default all; to get it anew takes the next frame longer than a launch. So the threshold follows the memory in use,
    # with room for a few frames, and falls to nothing with the owner. One that a program has set itself stays.

    def __init__(self, device: wp.Device):
        self._device = device if device.is_cuda and device.is_mempool_enabled else None
        if self._device is not None:
            weakref.finalize(self, _give_back, self._device).atexit = False

    def keep(self, size: int) -> None:
        """Keep memory for frames of so many bytes each, once they are dropped."""
        device = self._device
        if device is None:
            return
        spare = max(SPARE_FRAMES * size, MIN_SPARE)
        wanted, last = wp.get_mempool_used_mem_current(device) + spare, release_thresholds.get(device.ordinal, 0)
        if abs(wanted - last) > spare // 2 and wp.get_mempool_release_threshold(device) == last:
            wp.set_mempool_release_threshold(device, wanted)
            release_thresholds[device.ordinal] = wanted


def _give_back(device: wp.Device) -> None:
    """Let the pool of a device keep nothing, unless a program wants it to."""
    last = release_thresholds.pop(device.ordinal, 0)
    if last and wp.get_mempool_release_threshold(device) == last:
        wp.set_mempool_release_threshold(device, 0)


#: Numbers of a texel, and its bytes.
CHANNELS = 4

HALF_TEXEL_BYTES = 2 * CHANNELS

#: Texels along an axis that CUDA takes, at most.
MAX_TEXELS = 16384


def half_texture(shape: tuple[int, int, int], device: wp.DeviceLike) -> wp.Texture3D:
    """A texture of four halves a texel, (depth, height, width) texels, on a CUDA device; its values are not set yet.
    It is read at unnormalised coordinates, with linear interpolation."""
    depth, height, width = shape
    return wp.Texture3D(
        width=width,
        height=height,
        depth=depth,
        num_channels=CHANNELS,
        dtype=wp.float16,
        filter_mode=wp.TextureFilterMode.LINEAR,
        normalized_coords=False,
        surface_access=True,
        device=device,
    )
