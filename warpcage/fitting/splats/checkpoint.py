"""Progress of a fit of splats on disk, so that a fit that was stopped goes on."""

from __future__ import annotations

import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.files import atomic_path
from ...core.npz import require_numbers
from ...errors import InputError
from ..checkpoint import damage_as_error, fingerprint, read_checkpoint

if TYPE_CHECKING:
    from .optimizer import SplatFit

KIND, VERSION = "warpcage splat fit", 2

#: Arrays of a splat, and which of them a checkpoint holds: values, and means of slopes and of their squares.
NAMES = ("centers", "log_scales", "quaternions", "logits", "harmonics")
PARTS = ("values", "means", "squares")


def save_progress(fit: SplatFit, path: str | pathlib.Path) -> None:
    """Write splats with their means and the number of steps to a file (.npz), whole or not at all."""
    contents: dict[str, Any] = {
        "format": np.array(KIND),
        "version": np.array(VERSION),
        "fingerprint": np.array(fingerprint(fit)),
        "step_count": np.array(fit.step_count),
        "exposures": fit.exposure_state,
    }
    for part, rows in fit.growing.state().items():
        contents |= {f"{part}_{name}": array for name, array in rows.items()}
    with atomic_path(path) as temporary:
        np.savez(temporary, **contents)


def load_progress(fit: SplatFit, path: str | pathlib.Path) -> None:
    """Put a fresh fit, of the same scene, seed and options, where a saved one was."""
    known = ("format", "version", "fingerprint", "step_count", "exposures")
    names = {*known, *(f"{part}_{name}" for part in PARTS for name in NAMES)}
    contents = read_checkpoint(path, KIND, VERSION, names, fingerprint(fit))
    with damage_as_error(path):
        step = int(contents["step_count"])
        if not 0 <= step <= fit.total_steps:
            raise InputError(f"step {step} of {fit.total_steps}")
        count, found = fit.count_at(step), {part: {} for part in PARTS}
        for part in PARTS:
            for name, width in fit.growing.widths.items():
                shape = (count, width) if width > 1 else (count,)
                array = require_numbers(contents, f"{part}_{name}", shape, pathlib.Path(path))
                if not np.isfinite(array).all():
                    raise InputError("values that are not finite")
                found[part][name] = array
        exposures = require_numbers(contents, "exposures", fit.exposure_state.shape, pathlib.Path(path))
        if not np.isfinite(exposures).all():
            raise InputError("values that are not finite")
    fit.restore(step, found, exposures)
