"""The contents of a file of Gaussian splats as plain arrays, and checks of them."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.arrays import as_host_array
from ...core.checks import float32_spacing, listed, real_array, warn_caller
from ...core.names import agreed, counted
from ...errors import InputError
from ...field.io.field_file import Y0

#: Harmonics of degree 0 to 3, by the numbers of a colour channel.
DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}

#: A splat less opaque than this is not seen in pictures of bytes.
MIN_OPACITY = 1.0 / 255.0

#: Positions are rounded by much where float32 resolves no more than this share of the usual splat's length.
FINEST = 0.1

#: Opacities of bytes 0 and 255 are so far from 0 and 1.
_ALPHA_EDGE = 0.25 / 255.0

#: The arrays of SplatContents.
_ARRAYS = ("centers", "log_scales", "quaternions", "logits", "harmonics")

#: Logarithms of scales beyond which float32 cannot hold a covariance.
MAX_LOG_SCALE = 40.0


#: What formats of files may bound: coefficients of degree 0, as PLY files call them, those of higher ones, and scales.
FIRST, FURTHER, LOGS = "f_dc", "f_rest", "log scales"

#: The same of a format with float32 scales: below the least of them they are zero, which no splat has.
FLOAT_LOGS = (float(np.log(np.finfo(np.float32).tiny)), MAX_LOG_SCALE, 0.0)

#: Splats that may all be the same: handmade ones are few.
_FEW_EQUAL = 16

#: Rows that are no splats are left out up to this number, or this share of a file where that is more, but never more
#: than half of it; a file with more of them is damaged.
_FEW_BAD, _BAD_SHARE = 10, 0.01


@dataclasses.dataclass(frozen=True)
class PlyLayout:
    """A PLY file of splats but for the values that a SplatField has: all that a round trip must keep."""

    header: bytes  # as found, to the end of its last line
    before: bytes  # the elements before the splats, as found
    table: np.ndarray  # (n,) one row a splat, with all its properties in the order of the file
    after: bytes  # the elements after the splats, as found


@dataclasses.dataclass(frozen=True)
class SplatContents:
    """Splats as files hold them."""

    centers: np.ndarray  # (n, 3) float32 or float64, world units
    log_scales: np.ndarray  # (n, 3) float32, natural logarithms of the standard deviations along the splat's own axes
    quaternions: np.ndarray  # (n, 4) float32 w x y z, of any length; of length zero where the splat is not turned
    logits: np.ndarray  # (n,) float32, logarithm of opacity / (1 - opacity); infinite for 0 and 1
    harmonics: np.ndarray  # (n, b, 3) float32, b = 1, 4, 9 or 16 coefficients in red, green and blue
    layout: PlyLayout | None = None  # of the PLY file that they come from
    antialias: bool = False  # whether they were fitted with antialiasing, see `SplatField.render`

    @property
    def count(self) -> int:
        """Number of splats."""
        return len(self.centers)

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return DEGREES[self.harmonics.shape[1]]


def checked_contents(contents: SplatContents) -> SplatContents:
    """Splats whose arrays fit together and are finite; ValueError with the row of the first that is not."""
    _require_shapes(contents)
    for name in _ARRAYS:
        values = getattr(contents, name)
        bad = np.isnan(values) if name == "logits" else ~np.isfinite(values)
        if bad.any():
            row = int(np.argwhere(bad)[0][0])
            raise InputError(f"splat {row} has {name} that are not finite: {values[row].tolist()}")
    if contents.count and contents.log_scales.max() > MAX_LOG_SCALE:
        row = int(np.argmax(contents.log_scales.max(axis=1)))
        raise InputError(
            f"splat {row} has a scale of exp({contents.log_scales[row].max():.3g}): float32 cannot hold it"
        )
    return contents


def _require_shapes(contents: SplatContents) -> None:
    """Refuse arrays that do not fit together."""
    count, harmonics = len(contents.centers), contents.harmonics
    width = harmonics.shape[1] if harmonics.ndim == 3 else 1
    for name, shape in zip(_ARRAYS, ((3,), (3,), (4,), (), (width, 3)), strict=True):
        if (found := getattr(contents, name).shape) != (count, *shape):
            raise InputError(f"{name} of {count} splats must be {(count, *shape)}, got {found}")
    if width not in DEGREES:
        raise InputError(f"splats need {listed(DEGREES)} harmonics a channel, got {width}")


def rounding_of(contents: SplatContents, step: float | None = None) -> tuple[float, float]:
    """By how much positions are rounded, and the length of the usual splat, world units; 0 for the first where that is
    little beside the second, as it is near the origin. step: between two of a file, None for those of float32."""
    if not contents.count:
        return 0.0, 0.0
    rounded = float32_spacing(float(np.abs(contents.centers).max())) if step is None else step
    size = usual_size(contents)
    return (rounded if rounded > FINEST * size else 0.0), size


def usual_size(contents: SplatContents) -> float:
    """The largest standard deviation of the usual splat, world units."""
    return float(np.median(np.exp(contents.log_scales.max(axis=1).astype(np.float64))))


def bounded_values(contents: SplatContents) -> dict[str, np.ndarray]:
    """The arrays that formats may bound, by what they are."""
    harmonics = contents.harmonics
    return {FIRST: harmonics[:, 0], FURTHER: harmonics[:, 1:], LOGS: contents.log_scales}


def seen_logs(contents: SplatContents) -> np.ndarray:
    """Logarithms of scales (n, 3), none below FINEST of the usual splat: what is as thin or small looks the same."""
    logs = contents.log_scales
    return np.maximum(logs, np.log(FINEST * usual_size(contents))) if contents.count else logs


def joined(parts: Sequence[SplatContents], degree: int | None = None) -> SplatContents:
    """Splats one after another, their harmonics filled up with zeros to a degree; None is the highest of them."""
    if degree is None:
        if len(parts) == 1:
            return parts[0]
        degree = max(part.degree for part in parts)
    total = sum(part.count for part in parts)
    harmonics, begin = np.zeros((total, (degree + 1) ** 2, 3), np.float32), 0
    for part in parts:
        harmonics[begin : begin + part.count, : part.harmonics.shape[1]] = part.harmonics
        begin += part.count

    def all_of(name: str, *width: int) -> np.ndarray:
        return np.concatenate([np.zeros((0, *width), np.float32), *(getattr(part, name) for part in parts)])

    return SplatContents(
        all_of("centers", 3),
        all_of("log_scales", 3),
        all_of("quaternions", 4),
        all_of("logits"),
        harmonics,
        antialias=any(part.antialias for part in parts),
    )


def sound_contents(path: pathlib.Path, contents: SplatContents) -> SplatContents:
    """What of a file's splats can be used; path: for messages. A few rows that are none are left out, and counted in a
    warning; ValueError where they are more, and for fields that no program meant to write."""
    try:
        _require_shapes(contents)
        _require_field(contents)
        bad = bad_rows(contents)
        many, count = int(bad.sum()), contents.count
        if not many:
            return contents
        if many > min(max(_FEW_BAD, int(_BAD_SHARE * count)), count // 2):
            _refuse_rows(contents, many)
        warn_caller(
            f"{path}: {many} of {counted(count, 'splat')} {agreed(many, 'is', 'are')} left out, with values that are "
            f"not finite, too large, all zero, or scales of zero: the first is splat {np.argmax(bad)}"
        )
        return chosen_contents(contents, np.flatnonzero(~bad))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _refuse_rows(contents: SplatContents, many: int) -> None:
    """Refuse a file of many bad rows: what is wrong with the first of them."""
    try:
        checked_contents(contents)
    except ValueError as error:
        raise InputError(f"{error}: {many} of {contents.count} are such, so the file is damaged") from None
    raise InputError(
        f"all values of {many} of its {contents.count} splats are zero: the file was not filled to its end"
    )


def chosen_contents(contents: SplatContents, rows: np.ndarray) -> SplatContents:
    """The splats of some rows."""
    layout = chosen_layout(contents.layout, rows)
    return dataclasses.replace(contents, layout=layout, **{name: getattr(contents, name)[rows] for name in _ARRAYS})


def _require_field(contents: SplatContents) -> None:
    """Refuse values that are a file's room for splats, and not splats: zeros, or one row again and again."""
    count, turns = contents.count, contents.quaternions
    if not count:
        return
    if _are_zero(contents).all():
        raise InputError(f"all values of its {counted(count, 'splat')} are zero: the file was never filled")
    if np.isneginf(contents.log_scales).any(axis=1).all():
        raise InputError(f"the scales of its {counted(count, 'splat')} are zero: the file was never filled")
    if count > 1 and not turns.any():
        raise InputError(
            f"all its {count} quaternions are of length zero: write 1, 0, 0, 0 for splats that are not turned"
        )
    if count >= _FEW_EQUAL and (contents.centers == contents.centers[0]).all():
        raise InputError(f"all its {count} splats are at one place: the file is damaged")


def _are_zero(contents: SplatContents) -> np.ndarray:
    """(n,) bool which splats have no value but zero: the file's room for them."""
    axes = {name: tuple(range(1, getattr(contents, name).ndim)) for name in _ARRAYS}
    return ~np.any([getattr(contents, name).any(axis=axes[name]) for name in _ARRAYS], axis=0)


def bad_rows(contents: SplatContents) -> np.ndarray:
    """(n,) bool which splats have values that are not finite, that float32 cannot hold a covariance of, or none but
    zero. An opacity whose logit is infinite is 0 or 1, and good."""
    bad = np.isnan(contents.logits) | (contents.log_scales > MAX_LOG_SCALE).any(axis=1) | _are_zero(contents)
    for values in (contents.centers, contents.log_scales, contents.quaternions, contents.harmonics):
        bad |= ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    return bad


def logs_of(scales: np.ndarray) -> np.ndarray:
    """Logarithms of scales, float32. What has none becomes infinite or NaN."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.log(scales.astype(np.float64)).astype(np.float32)


def byte_logits(octets: np.ndarray) -> np.ndarray:
    """Logits of opacities in bytes (n,), float32: 0 and 255 are a quarter of a step from 0 and 1, and stay finite."""
    return logits_of(np.clip(octets / 255.0, _ALPHA_EDGE, 1.0 - _ALPHA_EDGE))


def unit_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) w x y z of length 1, float64; of length zero turn nothing."""
    values = quaternions.astype(np.float64)
    largest = np.abs(values).max(axis=1, keepdims=True, initial=0.0)
    values = np.where(largest > 0.0, values / np.where(largest > 0.0, largest, 1.0), [1.0, 0.0, 0.0, 0.0])
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def logits_of(opacities: np.ndarray) -> np.ndarray:
    """Logits of opacities (n,), 0 to 1; float32. 0 and 1 become infinite."""
    with np.errstate(divide="ignore"):
        return (np.log(opacities) - np.log1p(-opacities)).astype(np.float32)


def opacities_of(logits: np.ndarray) -> np.ndarray:
    """Opacities (n,) of logits; float64."""
    with np.errstate(over="ignore"):
        return 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))


def chosen_layout(layout: PlyLayout | None, rows: np.ndarray) -> PlyLayout | None:
    """The layout of some of the splats, or of copies; rows: (m,) the splat that each has its foreign values from."""
    if layout is None:
        return None
    whole = len(rows) == len(layout.table)  # elements after the splats may speak of all of them
    header = layout.header if whole else _without_elements_after(layout.header)
    return PlyLayout(header, layout.before, layout.table[rows], layout.after if whole else b"")


def _without_elements_after(header: bytes) -> bytes:
    """A header without the elements that follow the vertices."""
    lines, kept, seen = header.splitlines(keepends=True), [], False
    dropping = False
    for line in lines:
        tokens = line.split()
        if tokens[:1] == [b"element"]:
            dropping, seen = seen, seen or tokens[1] == b"vertex"
        if not (dropping and tokens[:1] in ([b"element"], [b"property"])):
            kept.append(line)
    return b"".join(kept)


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) float64 of quaternions (n, 4) w x y z of any length; of length zero for no rotation."""
    w, x, y, z = unit_quaternions(quaternions).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def contents_of_arrays(
    centers: Any, scales: Any, rotations: Any, opacities: Any, colors: Any, harmonics: Any
) -> SplatContents:
    """Splats of values as renderers have them, of arrays of any library; see `SplatField.from_arrays`."""
    places = np.asarray(as_host_array(centers, "centers"))
    places = real_array(places, "centers", np.float64 if places.dtype == np.float64 else np.float32)
    if places.ndim != 2:
        raise InputError(f"centers must be (n, 3), got {places.shape}")
    lengths, alphas = (
        real_array(as_host_array(each, name), name, np.float64)
        for each, name in ((scales, "scales"), (opacities, "opacities"))
    )
    for values, name, fits, what in (
        (lengths, "scales", lengths > 0.0, "above 0: standard deviations, not their logarithms"),
        (alphas, "opacities", (alphas >= 0.0) & (alphas <= 1.0), "in [0, 1]: not their logits"),
    ):
        if not fits.all():
            raise InputError(f"{name} must be {what}, got {values[~fits][0]:.3g}")
    if (colors is None) == (harmonics is None):
        raise InputError("splats have colors (n, 3) or harmonics (n, b, 3): give one of them")
    if harmonics is None:
        paint = (real_array(as_host_array(colors, "colors"), "colors", np.float64) - 0.5) / Y0
        coefficients = paint[:, None] if paint.ndim == 2 else paint
    else:
        coefficients = real_array(as_host_array(harmonics, "harmonics"), "harmonics", np.float32)
    turns = np.zeros((len(places), 4)) if rotations is None else as_host_array(rotations, "rotations")
    turns = real_array(turns, "rotations", np.float64)
    if turns.ndim == 3:
        turns = _quaternions(turns)
    with np.errstate(divide="ignore"):
        logits = np.log(alphas) - np.log1p(-alphas)
    logs, turns, logits, coefficients = (
        np.asarray(each, np.float32) for each in (np.log(lengths), turns, logits, coefficients)
    )
    return SplatContents(places, logs, turns, logits, coefficients)


def _quaternions(matrices: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z of rotations (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    if matrices.shape[1:] != (3, 3) or not np.allclose(matrices @ matrices.transpose(0, 2, 1), np.eye(3), atol=1e-3):
        raise InputError(f"rotations must be quaternions (n, 4) w x y z, or rotations (n, 3, 3), got {matrices.shape}")
    if not len(matrices):
        return np.zeros((0, 4))
    return np.roll(Rotation.from_matrix(matrices).as_quat(), 1, axis=1)
