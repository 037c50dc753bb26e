"""Progress of a fit of splats on disk, so that a fit that was stopped goes on."""

from __future__ import annotations

import hashlib
import json
import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.files import atomic_path, read_npz, require_numbers
from ...errors import InputError
from ..checkpoint import ROOM, scene_digest

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
    contents = read_npz(path, "checkpoint", names.__contains__, room=ROOM)
    if str(contents.get("format", "")) != KIND:
        raise InputError(f"{path} is no checkpoint of a fit of splats: remove it or name another file")
    if str(contents.get("version")) != str(VERSION):
        raise InputError(
            f"{path} is a checkpoint of another version ({str(contents.get('version'))[:20]}, this warpcage reads "
            f"{VERSION}): fit with the warpcage that wrote it, remove it or name another file"
        )
    if str(contents.get("fingerprint")) != fingerprint(fit):
        raise InputError(
            f"{path} is the checkpoint of another fit (scene, seed or options differ): remove it or name another file"
        )
    try:
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
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path} is a damaged fit checkpoint, remove it or name another file: {reason}") from error
    fit.restore(step, found, exposures)


def fingerprint(fit: SplatFit) -> str:
    """Hash, in hexadecimal digits, of all that a fit depends on: seed, options, scene, and where it began."""
    given = json.dumps(fit.given, sort_keys=True).encode()
    return hashlib.blake2b(given + scene_digest(fit.scene), digest_size=32).hexdigest()
