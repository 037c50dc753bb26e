"""Conversion of arrays (NumPy, DLPack, `__cuda_array_interface__`) and asynchronous copies to the host."""

from __future__ import annotations

import functools
import inspect
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..errors import InputError
from ..kernels.coordinates.local_points import NUMBERS, find_not_finite, localise_points
from .devices import launch, resolve_device
from .names import error_line
from .threads import device_turn

#: What DLPack calls main memory.
DLPACK_CPU = 1

_ROOT = __name__.removesuffix("core.arrays")  # "warpcage.", and another in copies of this module


#: Where gradients pass, by the name of the library that asks for one.
PASSING = "functions of warpcage.{}, such as deform_points, to_canonical and render, pass one"


class DLPackArray(Protocol):
    """An array of another library (torch, CuPy, JAX) that exports its memory."""

    def __dlpack__(self, *args: Any, **options: Any) -> Any: ...


#: An instance of a Warp struct. `wp.struct` makes a value of the class, which no annotation can name.
WarpStruct: TypeAlias = Any

#: Points as callers give them: NumPy, nested sequences, a Warp array, or one of another library.
PointsLike: TypeAlias = "ArrayLike | wp.array[Any, Any] | DLPackArray"


def is_device_array(array: object) -> bool:
    """Whether an array may be on a device: Warp's or another library's (torch, CuPy, JAX), not NumPy's."""
    if isinstance(array, wp.array):
        return True
    if isinstance(array, np.ndarray | list | tuple):
        return False
    # DLPack first: torch refuses even to say whether a tensor that requires grad has the other
    return hasattr(array, "__dlpack__") or hasattr(array, "__cuda_array_interface__")


def local_points(points: ArrayLike, origin: ArrayLike, device: wp.DeviceLike) -> wp.array:
    """(n,) vec3 of points (n, 3) of the world, relative to the point `origin`, for kernels."""
    return wp.array((np.asarray(points) - origin).astype(np.float32), dtype=wp.vec3, device=device)


def box_corners(box: ArrayLike) -> np.ndarray:
    """(8, 3) float64 corners of a box (2, 3), the z of the lower corner first, then its y."""
    low, high = np.asarray(box, np.float64)
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)


def empty_array(shape: int | tuple[int, ...], dtype: Any, device: wp.DeviceLike, *, pinned: bool = False) -> wp.array:
    """A Warp array whose values are not set yet; pinned memory of the CPU is page-locked."""
    return wp.empty(shape, dtype=dtype, device=device, pinned=pinned)  # whose annotations know float alone


def struct_array(structs: Sequence[WarpStruct], dtype: Any, device: wp.DeviceLike) -> wp.array:
    """Structs of one type as an array (n,) on the device; the caller keeps alive what their arrays point to."""
    # wp.array looks for a NumPy type of the struct each time and takes ten times as long.
    raw = np.frombuffer(b"".join(bytes(struct.__ctype__()) for struct in structs), dtype=np.uint8)
    return array_view(wp.array(raw, dtype=wp.uint8, device=device), dtype, len(structs))


def as_points(points: PointsLike, device: wp.DeviceLike = None, *, name: str = "points") -> wp.array[Any, Any]:
    """Points (n, 3) of any library as (n,) vec3 on the device; None is theirs, else CUDA where there is one.
    `as_given` gives results back as arrays of their kind."""
    # What is float32, contiguous and there is not copied. `require_finite` looks at values of a device.
    if not is_device_array(points):
        with np.errstate(over="ignore"):
            host = as_host_points(points, name=name).astype(np.float32)
        _require_finite_rows(host, name)
        return wp.array(host, dtype=wp.vec3, device=resolve_device(device))
    rows = device_rows(points, name)
    target = rows.device if device is None else resolve_device(device)
    if rows.dtype != wp.float32 or not rows.is_contiguous:
        rows = localised(rows, np.zeros(3), 1.0)[0]
    elif rows.size:
        rows = rows.view(wp.vec3)
    else:
        rows = empty_array(0, wp.vec3, rows.device)
    return moved(rows, target)


def as_numbers(values: Any, count: int, device: wp.Device, *, name: str) -> wp.array[Any, Any]:
    """(count,) numbers of any library, such as (n, 1) of torch, as float32 on the device, not copied where they are."""
    if is_device_array(values):
        require_no_gradient(values, name)
        found = values if isinstance(values, wp.array) else _from_foreign(values, name)
        if found.dtype != wp.float32:
            found = found.numpy()
    else:
        found = values
    if not isinstance(found, wp.array):
        try:
            found = wp.array(np.asarray(found, np.float32).reshape(-1), dtype=wp.float32, device=device)
        except (TypeError, ValueError):
            raise InputError(f"{name} must be ({count},) real numbers, got {type(values).__name__}") from None
    if found.size != count:
        raise InputError(f"{name} must be ({count},), got {tuple(found.shape)}")
    return moved(found.contiguous().flatten(), device)


#: Vectors of three that Warp arrays of points may be of, and their numbers.
VECTORS: dict[Any, Any] = {wp.vec3: wp.float32, wp.vec3d: wp.float64, wp.vec3h: wp.float16}


def device_rows(points: Any, name: str = "points") -> wp.array[Any, Any]:
    """Points of a device as they lie there: (n, 3) of one of the NUMBERS that kernels take, of any layout."""
    require_no_gradient(points, name)
    array: wp.array[Any, Any] = points if isinstance(points, wp.array) else _from_foreign(points, name)
    if array.dtype in VECTORS:
        if array.ndim != 1:
            raise InputError(f"{name} must be (n, 3), got {array.shape} of {array.dtype.__name__}")
        number = VECTORS[array.dtype]
        if not array.size:
            return empty_array((0, 3), number, array.device)
        strides: Any = (array.strides[0], wp.types.type_size_in_bytes(number))
        array = array_view(array, number, (len(array), 3), strides=strides)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {tuple(array.shape)}")
    if array.dtype not in NUMBERS:
        known = ", ".join(number.__name__ for number in NUMBERS)
        raise InputError(f"{name} on a device must be of {known}, got {array.dtype.__name__}")
    return array


def localised(rows: wp.array, center: np.ndarray, size: float) -> tuple[wp.array, wp.array]:
    """(rows - center) / size as (n,) vec3 on their device, and (3,) int: above 0 where one is not finite, or FARTHEST
    away; the last is for the caller."""
    local, bad = empty_array(len(rows), wp.vec3, rows.device), wp.zeros(3, dtype=int, device=rows.device)
    inputs = [rows, wp.vec3d(*center), wp.float64(size)]
    launch(localise_points, len(rows), inputs, [local, bad], device=rows.device)
    return local, bad


def as_given(array: wp.array, given: Any) -> Any:
    """A result as an array of the same kind as what was given: on its device, (n, 3) where it is vec3, not copied.
    NumPy for NumPy and sequences; Warp's for libraries without `from_dlpack`."""
    if not is_device_array(given):
        return array.numpy()
    if isinstance(given, wp.array):
        array = moved(array, given.device)
        return array if given.dtype in VECTORS else _flat(array)
    array = _flat(moved(array, _foreign_device(given)))
    take = _importer(given)
    return array if take is None else take(array)


def moved(array: wp.array, device: wp.Device | None) -> Any:
    """An array on a device, itself where it is there; None leaves it where it is."""
    return array if device is None or array.device == device else array.to(device)


def _flat(array: wp.array) -> wp.array:
    """(n, 3) float32 for (n,) vec3; others as they are."""
    if array.dtype != wp.vec3:
        return array
    shape = (len(array), 3)
    return array_view(array, wp.float32, shape) if array.size else empty_array(shape, wp.float32, array.device)


def _importer(given: Any) -> Callable[[Any], Any] | None:
    """What makes arrays of the library of an array, through DLPack."""
    for kind in type(given).__mro__:  # a class of somebody's own may extend a tensor
        take = getattr(sys.modules.get(kind.__module__.partition(".")[0]), "from_dlpack", None)
        if take is not None:
            return take
    namespace = getattr(given, "__array_namespace__", None)  # JAX keeps it elsewhere than its arrays' classes
    return None if namespace is None else getattr(namespace(), "from_dlpack", None)


def require_finite(*named: tuple[str, wp.array]) -> None:
    """Refuse points of one device, names and (n,) vec3, with a value that is not finite.
    It waits for the device. While a graph is captured nothing is checked."""
    device = named[0][1].device
    assert device is not None
    if device.is_cuda and device.is_capturing:
        return
    bad = wp.zeros(1, dtype=int, device=device)
    for _, points in named:
        launch(find_not_finite, len(points), [points], [bad], device=device)
    if int(bad.numpy()[0]):
        for name, points in named:
            as_host_points(points, name=name)


def require_no_gradient(points: Any, name: str) -> None:
    """Refuse an array that a gradient is asked of, as none passes: torch's and Warp's; JAX's are not arrays then."""
    recorded = False
    if isinstance(points, wp.array):
        recorded = points.requires_grad and _active_tape() is not None
        remedy = f"give wp.clone({name}, requires_grad=False), or leave this call out of the tape"
    else:
        torch = sys.modules.get("torch")
        recorded = bool(getattr(points, "requires_grad", False)) and (torch is None or torch.is_grad_enabled())
        remedy = f"{PASSING.format('torch')}; else give {name}.detach(), or call it under torch.no_grad()"
    if recorded:
        raise InputError(f"no gradient passes from here to {name}, which require one: {remedy}")


def _active_tape() -> Any:
    """The wp.Tape that records launches, or None."""
    return getattr(getattr(sys.modules.get("warp._src.context"), "runtime", None), "tape", None)


_Function = TypeVar("_Function", bound=Callable[..., Any])


def points_in_turn(function: _Function) -> _Function:
    """Let a function that takes points first, and a `device`, hold `device_turn` of the device that it works on."""
    place = list(inspect.signature(function).parameters).index("device") - 1

    @functools.wraps(function)
    def turn(points: Any, *args: Any, **options: Any) -> Any:
        device = args[place] if len(args) > place else options.get("device")
        with device_turn(points_device(points, device)):
            return function(points, *args, **options)

    return turn  # pyright: ignore[reportReturnType]


def points_device(points: Any, device: wp.DeviceLike) -> wp.Device:
    """Where a function of points works: on the device that was asked for, else on that of the points."""
    return resolve_device(_foreign_device(points) if device is None else device)


def _foreign_device(points: Any) -> wp.Device | None:
    """The device of an array that is no NumPy; None where it does not say so."""
    if isinstance(points, wp.array):
        return points.device
    if not (is_device_array(points) and hasattr(points, "__dlpack_device__")):
        return None
    try:
        kind, index = points.__dlpack_device__()
    except Exception as error:  # libraries raise of all kinds
        raise _unreadable(points, "points", error) from error
    return resolve_device("cpu" if int(kind) == DLPACK_CPU else f"cuda:{int(index)}")


def as_host_points(points: PointsLike, *, name: str = "points") -> np.ndarray:
    """Points (n, 3) of finite real numbers as NumPy: (n, 3) float64, a copy."""
    host = as_host_array(points, name)
    try:
        host = np.asarray(host)
        host = host.astype(np.float64, casting="unsafe" if host.dtype == object else "same_kind")
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} must be (n, 3) real numbers, got {type(points).__name__}") from None
    if host.shape == (0,):  # an empty list
        host = host.reshape(0, 3)
    if host.ndim != 2 or host.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {host.shape}")
    _require_finite_rows(host, name)
    return host


def _require_finite_rows(host: np.ndarray, name: str) -> None:
    if not np.isfinite(host).all():
        row = int(np.flatnonzero(~np.isfinite(host).all(axis=1))[0])
        raise InputError(f"{name} must be finite, row {row} is {host[row]}")


def as_host_array(array: Any, name: str) -> Any:
    """An array of any library and device as NumPy; what is no array stays as it is. Refused where a gradient is asked
    of it."""
    if not is_device_array(array):
        return array
    require_no_gradient(array, name)
    return (array if isinstance(array, wp.array) else _from_foreign(array, name)).numpy()


def _from_foreign(array: Any, name: str) -> wp.array:
    """A Warp array over the memory of an array of another library, behind what that library has launched."""
    if getattr(array, "requires_grad", False):
        array = array.detach()
    try:
        if hasattr(array, "__dlpack__"):
            found = wp.from_dlpack(array)
        else:  # the stream that makes it is not known
            found = wp.array(array, copy=False)
            wp.synchronize_device(found.device)
    except Exception as error:
        raise _unreadable(array, name, error) from error
    assert isinstance(found, wp.array)
    return found


def _unreadable(array: Any, name: str, error: Exception) -> InputError:
    """The refusal of an array whose library does not export its memory."""
    kind = type(array).__name__
    reason = PASSING.format("jax") if kind.endswith("Tracer") else error_line(error)
    return InputError(f"{name} of type {kind} could not be read through DLPack: {reason}")


def array_view(
    owner: wp.array,
    dtype: Any,
    shape: int | tuple[int, ...],
    *,
    device: wp.DeviceLike = None,
    offset: int = 0,
    strides: tuple[int, ...] | None = None,
) -> wp.array:
    """The memory of an array, which stays alive, as an array of another type, shape or device (CUDA for pinned memory).
    Offset and strides are bytes; None is the owner's device, and strides without gaps."""
    assert owner.ptr is not None  # Warp's own views (slices, `reshape`, `view`) do as well, where they suffice
    view = wp.array(
        ptr=owner.ptr + offset,
        dtype=dtype,
        shape=shape,
        strides=strides,
        device=owner.device if device is None else device,
        copy=False,
    )
    view._ref = owner  # where Warp's own views keep theirs
    return view


def array_bytes(item: object, leave: Sequence[object] = ()) -> int:
    """Bytes, on devices and in main memory, of an object's arrays and textures at any depth; not those of `leave`."""
    held: dict[tuple[str, int], int] = {}  # views count once; only objects of this package and Warp structs are opened
    seen, open_objects = {id(each) for each in leave}, [item]
    while open_objects:
        each = open_objects.pop()
        if id(each) in seen or each is None or isinstance(each, str | bytes | int | float):
            continue
        seen.add(id(each))
        if isinstance(each, wp.array):
            whole = _whole(each)
            if whole.ptr:
                held[str(whole.device), whole.ptr] = whole.capacity
        elif isinstance(each, wp.Texture3D):
            texels = each.width * each.height * each.depth * each.num_channels
            held["texture", id(each)] = texels * wp.types.type_size_in_bytes(each.dtype)
        elif isinstance(each, np.ndarray):
            base = each
            while isinstance(base.base, np.ndarray):
                base = base.base
            held["host", id(base)] = base.nbytes
        elif isinstance(each, dict):
            open_objects += each.values()
        elif isinstance(each, list | tuple | set):
            open_objects += each
        elif type(each).__module__.startswith(_ROOT) or hasattr(each, "_ctype"):  # which structs have
            open_objects += _attributes(each)
    return sum(held.values())


def _whole(array: Any) -> Any:
    """The Warp array that a view is a part of."""
    while isinstance(getattr(array, "_ref", None), wp.array):
        array = array._ref
    return array


def _attributes(item: Any) -> list[Any]:
    """The values of an object's attributes, those of slots too."""
    names = [name for kind in type(item).__mro__ for name in getattr(kind, "__slots__", ())]
    return [*getattr(item, "__dict__", {}).values(), *(getattr(item, name, None) for name in names)]


#: Bytes of page-locked memory for the copies of a device, at most. Further ones are waited for when they are made.
MAX_STAGED = 1 << 28

#: Sizes of pieces of that memory are multiples of this.
PIECE = 1 << 16

#: Seconds between two looks at a copy, and after which the device is asked whether it still works.
LOOK, PATIENCE = 2.0e-4, 2.0

#: Bytes at the beginning of a piece, where the number stands.
HEAD = 64

#: The number where no `state` is given.
THERE = 1


class HostCopy:
    """A copy of a contiguous array on a CUDA device, as it is when all is done that was launched before.
    `state`, (1,) int32 on its device and not 0 by then, comes with the copy; None is THERE."""

    # Behind each copy the device writes a number into memory that the host reads: any thread that needs the copy polls
    # it, without a call to the device. `device_turn` stays with the thread that launches.

    def __init__(self, array: wp.array, state: wp.array | None = None):
        assert array.device is not None
        self._device = array.device
        with device_turn(self._device):
            self._piece = staging_memory(self._device.ordinal).take(array.capacity)
            if self._piece is None:
                self._found = array.numpy(), THERE if state is None else int(state.numpy()[0])
                return
            self._piece.send(array, state)

    def wait(self) -> tuple[np.ndarray, int]:
        """Wait until it is there: (bytes,) uint8, and the number of `state`; RuntimeError where the device failed.
        The memory is given to other copies once nothing refers to the array."""
        if self._piece is None:
            array, state = self._found
            return array.reshape(-1).view(np.uint8), state
        patience = time.monotonic() + PATIENCE
        while not self._piece.state:
            time.sleep(LOOK)
            if time.monotonic() > patience:
                with device_turn(self._device):
                    staging_memory(self._device.ordinal).there.numpy()  # waits, and raises where the device failed
                patience = time.monotonic() + PATIENCE
        return np.asarray(self._piece), self._piece.state


class _Piece:
    """A piece of page-locked memory, for one copy. It is given back when nothing refers to it or to its array."""

    def __init__(self, staging: _Staging, block: wp.array, size: int):
        self._staging, self._block, self._size = staging, block, size
        assert block.ptr is not None
        self.__array_interface__ = {"version": 3, "shape": (size,), "typestr": "|u1", "data": (block.ptr + HEAD, False)}

    @property
    def state(self) -> int:
        """The number behind the copy; 0 until it is there."""
        return _state(self._block)

    def send(self, array: wp.array, state: wp.array | None) -> None:
        """Launch the copy."""
        self._block.numpy()[:HEAD] = 0
        wp.copy(array_view(self._block, wp.uint8, self._size, offset=HEAD), array_view(array, wp.uint8, self._size))
        wp.copy(array_view(self._block, wp.int32, 1), self._staging.there if state is None else state)

    def __del__(self):
        self._staging.give_back(self._block)


class _Staging:
    """Page-locked memory for copies from a device, used again and again."""

    def __init__(self, ordinal: int):
        self._lock = threading.Lock()
        self._free: dict[int, list[wp.array]] = {}
        self.held_bytes = 0  # in pieces, free and in use
        self.there = wp.full(1, THERE, dtype=wp.int32, device=f"cuda:{ordinal}")

    def take(self, size: int) -> _Piece | None:
        """A piece of so many bytes; None where there is no more memory for one."""
        rounded = -(-(HEAD + size) // PIECE) * PIECE
        with self._lock:
            free = self._free.setdefault(rounded, [])
            # a piece that was dropped before its copy ended may still be written to
            place = next((place for place, block in enumerate(free) if _state(block)), None)
            if place is not None:
                return _Piece(self, free.pop(place), size)
            if self.held_bytes + rounded > MAX_STAGED:
                self._drop_free()
            if self.held_bytes + rounded > MAX_STAGED:
                return None
            self.held_bytes += rounded
        return _Piece(self, empty_array(rounded, wp.uint8, "cpu", pinned=True), size)

    def give_back(self, block: wp.array) -> None:
        """Take a piece for used no more. It may be called in any thread, wherever something is freed."""
        self._free[block.size].append(block)

    def _drop_free(self) -> None:
        """Free the pieces that are not in use, of all sizes."""
        for size, free in self._free.items():
            for place in reversed(range(len(free))):  # others may come at the end meanwhile
                if _state(free[place]):
                    del free[place]
                    self.held_bytes -= size


def _state(block: wp.array) -> int:
    """The number at the beginning of a piece."""
    return int(block.numpy()[:4].view(np.int32)[0])


@functools.cache
def staging_memory(ordinal: int) -> _Staging:
    """The page-locked memory of a CUDA device, by its number."""
    return _Staging(ordinal)
