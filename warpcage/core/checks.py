"""Checks of values that callers give, and warnings to them."""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
import math
import os
import pathlib
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, UseError
from ..package import WITHOUT_OLD_NAMES, renamed_line
from .names import CURVE, EASINGS, Easing, checked_choice, error_line, shown
from .names import listed as listed

#: Most samples that a caller may ask for along the diagonal of a field: with more a picture takes minutes, and no pixel
#: differs.
MAX_SAMPLES = 100_000

#: Smallest and largest longest side of what float32 kernels compute in world units, whose squares and ratios to voxels
#: they hold.
SMALLEST_SIDE, LARGEST_SIDE = 1e-9, 1e9

#: The largest float16.
MAX_HALF = 65504.0

#: Names of the axes, in their order.
AXES = "xyz"

Decorated = TypeVar("Decorated", bound=Callable[..., Any])


def require_type(value: object, kind: type, what: str) -> None:
    """Refuse an object of another type; `what` begins the message: "`what` a `kind`, got ..."."""
    if not isinstance(value, kind):
        raise InputError(f"{what} a {kind.__name__}, got {type(value).__name__}")


def checked_number(value: Any, name: str, minimum: float | None = None, maximum: float | None = None) -> float:
    """One finite number in a range (None: no limit), or an array of no dimensions, as a float; a bool is none."""
    number = _number(value)
    if math.isfinite(number) and (minimum is None or number >= minimum) and (maximum is None or number <= maximum):
        return number
    kind = (
        "one finite number"
        if minimum is None
        else f"a finite number of at least {minimum:g}"
        if maximum is None
        else f"a number from {minimum:g} to {maximum:g}"
    )
    raise InputError(f"{name} must be {kind}, got {shown(value)}")


def checked_easing(value: Any, what: str) -> Easing:
    """One of EASINGS, or a curve of one's own with its four numbers as floats; x1 and x2 are times from 0 to 1."""
    if isinstance(value, str):
        return checked_choice(value, what, EASINGS)
    if not isinstance(value, Mapping) or set(value) != {"bezier"}:
        raise InputError(f"{what} must be one of {', '.join(EASINGS)}, or {CURVE}, got {shown(value)}")
    numbers = value["bezier"]
    if not isinstance(numbers, list | tuple) or len(numbers) != 4:
        raise InputError(f"{what} must have four numbers, {CURVE}, got {shown(numbers)}")
    named = zip(("x1", "y1", "x2", "y2"), numbers, strict=True)
    return {"bezier": [checked_number(x, f"{name} of {what}", *((0, 1) if "x" in name else ())) for name, x in named]}


def checked_positive(value: Any, name: str) -> float:
    """One positive, finite number, or an array of no dimensions, as a float."""
    number = _number(value)
    if not (math.isfinite(number) and number > 0.0):
        raise InputError(f"{name} must be positive and finite, got {shown(value)}")
    return number


def checked_step(step: float | None, default: float) -> float:
    """A march step, world units; None takes `default`."""
    return default if step is None else checked_positive(step, "the march step")


def checked_march(step: float | None, default: float, diagonal: float, distance: float) -> float:
    """The step of a march from a camera through a field; all are world units, None takes `default`.
    `diagonal` is that of the field's box, `distance` goes from the camera to the middle of it."""
    number, shortest = checked_step(step, default), diagonal / MAX_SAMPLES
    if step is not None and number < shortest:
        raise InputError(
            f"the march step must be at least {shortest:.3g} ({MAX_SAMPLES} in the field), got {shown(step)}"
        )
    smallest = 2.0 * float32_spacing(distance + diagonal)
    if not smallest <= number:
        farthest = 2.0**21 * number - diagonal
        remedy = f", or move it to within {farthest:.3g}" if farthest > 0 else ""
        raise InputError(
            f"a camera {distance:.3g} from the middle of the field is too far for march steps of {number:.3g}, which "
            f"float32 cannot resolve there: take a step of at least {smallest:.3g}{remedy}"
        )
    return number


def float32_spacing(value: float) -> float:
    """The distance from a number's absolute value to the next float32 number; infinite beyond float32."""
    if not abs(value) < float(np.finfo(np.float32).max):
        return math.inf
    return float(np.spacing(np.float32(abs(value))))


def require_ordinary_side(side: float, what: str) -> None:
    """Refuse a longest side, world units, that float32 kernels cannot take: outside SMALLEST_SIDE .. LARGEST_SIDE."""
    if not SMALLEST_SIDE <= side <= LARGEST_SIDE:
        raise InputError(
            f"{what} has a longest side of {side:.3g} units: kernels can work with {SMALLEST_SIDE:g} to "
            f"{LARGEST_SIDE:g}, scale it (and its cameras) to another unit"
        )


def checked_whole(value: Any, name: str, minimum: int, maximum: int | None = None) -> int:
    """A whole number, of Python or NumPy, in a range (None: no limit) as an int; a bool is none."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < minimum or (maximum is not None and value > maximum):
        span = f"of at least {minimum}" if maximum is None else f"from {minimum} to {maximum}"
        raise InputError(f"{name} must be a whole number {span}, got {shown(value)}")
    return int(value)


def checked_flag(value: Any, name: str) -> bool:
    """A bool of Python or NumPy as Python's; text is refused, which would always be true."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be true or false, got {shown(value)}")
    return bool(value)


def checked_path(path: Any, name: str) -> pathlib.Path:
    """The name of a file or a folder, text or a path."""
    if not isinstance(path, str | os.PathLike) or isinstance(os.fspath(path), bytes):
        raise InputError(f"{name} must be a path, got {type(path).__name__}")
    return pathlib.Path(path)


def real_array(values: Any, name: str, dtype: Any = np.float64) -> np.ndarray:
    """Real numbers of any shape as an array, the one that was given where it fits."""
    try:
        given = np.asarray(values)
        # of other objects NumPy makes floats too: None becomes NaN, and text is read
        unreal = given.dtype == object and any(value is None or isinstance(value, str | bytes) for value in given.flat)
        if given.dtype.kind in "biuf" or (given.dtype == object and not unreal):
            return given.astype(dtype, copy=False)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{name} must be real numbers, got {shown(values)}")


def checked_vector(value: ArrayLike, name: str) -> np.ndarray:
    """A point or a direction: (3,) float64, finite."""
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{name} must be 3 finite numbers, got {shown(value)}")
    return vector


def checked_direction(value: ArrayLike, name: str) -> np.ndarray:
    """A direction, of any length but zero, as a unit vector (3,) float64."""
    direction = checked_vector(value, name)
    length = np.linalg.norm(direction)
    if not length > 0:
        raise InputError(f"{name} must be a direction, got {direction.tolist()}")
    return direction / length


def checked_bounds(bounds: ArrayLike, name: str = "bounds") -> np.ndarray:
    """An axis-aligned box: (2, 3) float64, lower and upper corner, read-only."""
    box = real_array(bounds, name).copy()
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise InputError(f"{name} must be (2, 3), finite, lower below upper, got {box.tolist()}")
    box.setflags(write=False)
    return box


def axis_index(axis: str) -> int:
    """The number of an axis: 0, 1 or 2 for "x", "y" or "z"."""
    if not isinstance(axis, str) or len(axis) != 1 or axis not in AXES:
        raise InputError(f"axis must be 'x', 'y' or 'z', got {shown(axis)}")
    return AXES.index(axis)


def _number(value: Any) -> float:
    """One number as a float, NaN for what is none."""
    # what has a number's type is not shown to NumPy, which took a third of the time of a large job file
    try:
        if isinstance(value, _NO_NUMBERS) or not (isinstance(value, (float, int)) or np.ndim(value) == 0):
            return math.nan
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


#: Types that `float` takes, but which are no numbers.
_NO_NUMBERS = (bool, np.bool_, str, bytes)


#: The folder of the whole package: frames in it are not the caller's.
_PACKAGE = str(pathlib.Path(__file__).parents[1]) + os.sep


def warn_caller(message: str) -> None:
    """Give a UserWarning at the line of the caller outside this package, however deep inside it the call is."""
    depth, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(message, stacklevel=depth + 1)


class Cuts:
    """Counts values that are clipped to the range of a file format, for one warning per file."""

    # All clipping is reported by default; otherwise only where more than a share of the numbers is more than `beside`
    # beyond the range, or one more than `far`.
    def __init__(self, *, beside: float = 0.0, share: float = 0.0, far: float = 0.0):
        self._beside, self._share, self._far = beside, share, far
        # how many are cut, how many by more than `beside`, of how many, and by how much at most, by what they are
        self._found: dict[str, tuple[int, int, int, float]] = {}
        self._lock = threading.Lock()

    def clip(self, what: str, values: np.ndarray, low: float, high: float, step: float) -> np.ndarray:
        """Numbers clipped to a range. Counted are those beyond it by more than half a step of the format.
        what: their name, in the plural."""
        if not values.size:
            return values
        least, most = (float(each.reduce(values, axis=None)) for each in (np.fmin, np.fmax))  # NaN is none
        beyond = max(low - least, most - high)
        cut, wide = (
            int(np.count_nonzero((values < low - each) | (values > high + each))) if beyond > each else 0
            for each in (0.5 * step, max(0.5 * step, self._beside))
        )
        what = f"{what} beyond {low:.3g} to {high:.3g}" if low < high else f"{what} other than {low:.3g}"
        with self._lock:
            old = self._found.get(what, (0, 0, 0, 0.0))
            self._found[what] = (old[0] + cut, old[1] + wide, old[2] + values.size, max(old[3], beyond))
        return np.clip(values, low, high) if beyond > 0.0 else values

    def warn(self, file: object, kept: str = "") -> bool:
        """Warn of clipped values; returns whether there are any. kept: end of the line, which format keeps them."""
        text = self.text(kept)
        if text:
            warn_caller(f"{file}: {text}")
        return bool(text)

    def text(self, kept: str = "") -> str:
        """The text of the warning; "" for none."""
        parts = [
            f"{cut} of {total} {what}, by up to {most:.3g}"
            for what, (cut, wide, total, most) in self._found.items()
            if wide > self._share * total or (cut and most > self._far)
        ]
        return f"cut to what its format holds: {'; '.join(parts)}{f': {kept}' if kept else ''}" if parts else ""


def registered_formats(group: str, what: str, require: Callable[[object], None]) -> Iterable[Any]:
    """Formats that other packages register under a group of entry points, by name; unusable ones are left out with a
    warning. what: their name in messages, such as "the mesh format"; require: raises for an object that is none."""
    for entry in sorted(importlib.metadata.entry_points(group=group), key=lambda entry: entry.name):
        try:
            format = entry.load()
            require(format)
        except Exception as error:  # whatever another package raises
            warn_caller(f"{what} {entry.name!r} of {entry.value} cannot be used: {error_line(error, 200)}")
        else:
            yield format


def format_lines(formats: Iterable[Any]) -> list[str]:
    """A line for each file format: name, endings, and whether it is read and written."""
    return [
        f"{format.name} ({' '.join(format.endings)}): "
        + " and ".join(verb for verb, can in (("read", format.read), ("written", format.write)) if can)
        for format in formats
    ]


def require_endings(endings: tuple[str, ...]) -> None:
    """Refuse file endings of a format that are not in lower case or do not begin with a dot."""
    if not endings or not all(each.startswith(".") and each == each.lower() for each in endings):
        raise InputError(f"its endings must be lower case and begin with a dot, got {endings!r}")


def warn_renamed(old: str, new: str) -> None:
    """Warn the caller of an old name."""
    warn_caller(renamed_line(old, new))


def renamed(**names: str) -> Callable[[Decorated], Decorated]:
    """Decorates a function or class whose arguments were renamed: with center="centre" it still takes centre=."""

    def decorate(decorated: Any) -> Any:  # a function or a class
        function = decorated.__init__ if isinstance(decorated, type) else decorated

        @functools.wraps(function)
        def accepting(*values: Any, **options: Any) -> Any:
            for new, old in names.items():
                if old in options:
                    if new in options:
                        raise UseError(f"{old} is the old name of {new}: give one of them")
                    warn_renamed(f"{old}=", f"{new}=")
                    options[new] = options.pop(old)
            return function(*values, **options)

        if isinstance(decorated, type):
            decorated.__init__ = accepting
            return decorated
        return accepting

    return decorate


def device_by_name(function: Decorated) -> Decorated:
    """Decorates a function whose `device` became keyword-only: it still takes it as its last positional argument."""
    call: Any = function
    kinds = [parameter.kind for parameter in inspect.signature(function).parameters.values()]
    most = sum(kind is inspect.Parameter.POSITIONAL_OR_KEYWORD for kind in kinds)

    @functools.wraps(function)
    def accepting(*values: Any, **options: Any) -> Any:
        if len(values) == most + 1 and "device" not in options:
            warn_caller(f"give the device by name, device=: by position it goes with warpcage {WITHOUT_OLD_NAMES}")
            values, options["device"] = values[:-1], values[-1]
        return call(*values, **options)

    return accepting  # pyright: ignore[reportReturnType]
