"""What a file of Gaussian splats holds, as plain arrays."""

from __future__ import annotations

import dataclasses

import numpy as np

from ...core.checks import float32_spacing, listed

#: The first of the real harmonics, Y_0.
Y0 = 0.28209479177387814

#: Harmonics of degree 0 to 3, by the numbers of a colour channel.
DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}

#: A splat less opaque than this is not seen in pictures of bytes.
LEAST_OPACITY = 1.0 / 255.0

#: Positions are rounded by much where float32 tells apart no more than this share of the usual splat's length.
FINEST = 0.1

#: Logarithms of scales beyond which float32 cannot hold a covariance.
MOST_LOG_SCALE = 40.0


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
    antialias: bool = False  # whether they were fitted with what `SplatField.render` calls by this name

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
    count = len(contents.centers)
    shapes = {
        "centers": (count, 3),
        "log_scales": (count, 3),
        "quaternions": (count, 4),
        "logits": (count,),
        "harmonics": (count, contents.harmonics.shape[1] if contents.harmonics.ndim == 3 else 1, 3),
    }
    for name, shape in shapes.items():
        values = getattr(contents, name)
        if values.shape != shape:
            raise ValueError(f"{name} of {count} splats must be {shape}, got {values.shape}")
        bad = np.isnan(values) if name == "logits" else ~np.isfinite(values)
        if bad.any():
            row = int(np.argwhere(bad)[0][0])
            raise ValueError(f"splat {row} has {name} that are not finite: {values[row].tolist()}")
    if contents.harmonics.shape[1] not in DEGREES:
        raise ValueError(f"splats need {listed(DEGREES)} harmonics a channel, got {contents.harmonics.shape[1]}")
    if count and contents.log_scales.max() > MOST_LOG_SCALE:
        row = int(np.argmax(contents.log_scales.max(axis=1)))
        raise ValueError(
            f"splat {row} has a scale of exp({contents.log_scales[row].max():.3g}): float32 cannot hold it"
        )
    return contents


def rounding_of(contents: SplatContents) -> tuple[float, float]:
    """By how much float32 rounds positions, and the length of the usual splat, world units; 0 for the first where that
    is little beside the second, as it is anywhere near the origin."""
    if not contents.count:
        return 0.0, 0.0
    rounded = float32_spacing(float(np.abs(contents.centers).max()))
    size = float(np.median(np.exp(contents.log_scales.max(axis=1).astype(np.float64))))
    return (rounded if rounded > FINEST * size else 0.0), size


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
        words = line.split()
        if words[:1] == [b"element"]:
            dropping, seen = seen, seen or words[1] == b"vertex"
        if not (dropping and words[:1] in ([b"element"], [b"property"])):
            kept.append(line)
    return b"".join(kept)
