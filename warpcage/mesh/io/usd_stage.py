"""Stages of USD through usd-core, and what goes wrong with them in one line."""

from __future__ import annotations

import contextlib
import importlib
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core.names import error_line, extra_line
from ...errors import InputError, MissingPackageError
from .gltf import local_matrix


def usd_library() -> Any:
    """The package of usd-core."""
    try:
        for part in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "UsdVol", "Vt"):
            importlib.import_module(f"pxr.{part}")
        return importlib.import_module("pxr")
    except ImportError as error:
        raise MissingPackageError(f"USD needs its library: {extra_line('usd')}") from error


@contextlib.contextmanager
def errors_of_stage(path: pathlib.Path, what: str = "not a USD file that can be read") -> Iterator[None]:
    """What the library of USD refuses, as a ValueError of one line that names the file."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except (usd_library().Tf.ErrorException, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {what}: {_reason_of(error)}") from None


def _reason_of(error: Exception) -> str:
    """What an error of USD says, without the names of its own functions and files."""
    try:
        return error_line(error).rpartition(" : ")[2].strip("'")[-160:]
    except UnicodeDecodeError:  # of its message, which quotes the file
        return "its text is not UTF-8"


def opened_stage(path: pathlib.Path) -> Any:
    """The stage of a USD file as it is now."""
    with errors_of_stage(path):
        stage = usd_library().Usd.Stage.Open(str(path))
        for layer in stage.GetUsedLayers():  # USD keeps layers that somebody holds, such as the frames of an error
            if not (layer.anonymous or layer.dirty):
                layer.Reload()  # where its file is another one by now
        return stage


def attribute_times(attribute: Any) -> list[float]:
    """The times at which a value of an attribute is given, by samples or by the knots of a spline. One that goes on
    beyond its knots, in loops or straight, does so from the start to the end of the stage."""
    if not attribute.HasSpline():
        return list(attribute.GetTimeSamples())
    if usd_library().Usd.GetVersion() < (0, 25, 11):  # older ones stand still, or end a loop wrongly
        raise InputError("it moves by splines: they are read with usd-core 25.11 and later")
    spline, stage, curves = attribute.GetSpline(), attribute.GetStage(), importlib.import_module("pxr.Ts")
    times = [float(time) for time in spline.GetKnotsWithInnerLoopsBaked()]
    ends = (
        (spline.GetPreExtrapolation(), stage.GetStartTimeCode()),
        (spline.GetPostExtrapolation(), stage.GetEndTimeCode()),
    )
    goes_on = [time for end, time in ends if end.mode not in (curves.ExtrapHeld, curves.ExtrapValueBlock)]
    return [*times, *goes_on] if stage.HasAuthoredTimeCodeRange() else times


def placers_of(prim: Any) -> Iterator[Any]:
    """What places a prim: itself and all above it, up to one that begins anew."""
    transforms = usd_library().UsdGeom.Xformable
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(transforms):
            yield transforms(prim)
            if transforms(prim).GetResetXformStack():
                return
        prim = prim.GetParent()


def step_matrix(step: Any, time: Any) -> np.ndarray:
    """(4, 4) float64 of a step of a transform, for rows of points."""
    if step.GetOpType() != step.TypeOrient:
        return np.array(step.GetOpTransform(time))
    # USD takes the angle from the real part alone, which half floats round to 1 below 2.5 degrees
    held = step.Get(time)
    if held is None:
        return np.eye(4)
    numbers = np.array([*held.imaginary, held.real], np.float64)
    length = np.linalg.norm(numbers)
    matrix = local_matrix({"rotation": numbers / length}) if length > 0.0 else np.eye(4)
    return matrix if step.IsInverseOp() else matrix.T


def still_value(attribute: Any, begin: Any) -> Any:
    """What an attribute says without a time, or else at the first."""
    held = attribute.Get()
    return attribute.Get(begin) if held is None else held


def still_matrix(prim: Any, begin: Any) -> np.ndarray:
    """(4, 4) float64 from a prim to the stage's world, for rows of points, of what stands still: see `still_value`."""
    default, matrix = usd_library().Usd.TimeCode.Default(), np.eye(4)
    for above in placers_of(prim):
        for step in reversed(above.GetOrderedXformOps()):
            with np.errstate(invalid="ignore"):  # of what is not finite
                matrix = matrix @ step_matrix(step, default if step.Get() is not None else begin)
    return matrix
