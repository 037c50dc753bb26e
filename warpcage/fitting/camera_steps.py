"""Steps of cameras and exposures from what a sample of their rays says, in NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..kernels.fitting import cameras as kernels

NUMBERS, SUMS = int(kernels.CAMERA_NUMBERS), int(kernels.CAMERA_SUMS)
_NORMAL, _EXPOSURE = int(kernels.NORMAL_SUMS), int(kernels.EXPOSURE_SUMS)

#: What Gauss-Newton's diagonal is raised by, as a share of itself and of the camera's largest: steps are short along
#: what the pictures tell badly, as a turn and a shift across it that show the object the same way.
DAMPING, LEAST_DAMPING = 0.05, 1e-5

#: How firmly the given cameras hold theirs at least, relative to what the pictures tell best: turns, shifts and focal
#: length.
HOLD = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3, 1e-3])

#: Strength of the exposures' prior, as a share of the pixels' number: that gains are 1 and offsets 0.
EXPOSURE_PRIOR, OFFSET_PRIOR = 0.005, 0.3

#: Gains of an exposure beyond these are not believed.
GAINS = (0.2, 5.0)

#: Keeps quotients finite where no ray tells anything.
TINY = 1e-30


@dataclasses.dataclass(frozen=True, eq=False)
class CameraSums:
    """What a sample of rays says of their cameras."""

    # (n, 7, 7) float64, J^T J by turns, shifts and logarithm of the focal length
    normal: np.ndarray
    # (n, 7) J^T e
    slope: np.ndarray
    # (n, 3, 5) sums of x x, x a, a a, x y and a y for each channel; see kernels/fitting/cameras
    exposure: np.ndarray
    # (n,) e^T e
    error: np.ndarray

    @classmethod
    def unpacked(cls, sums: np.ndarray) -> CameraSums:
        """From (n, 51) as the kernel packs them."""
        normal = np.zeros((len(sums), NUMBERS, NUMBERS))
        rows, columns = np.triu_indices(NUMBERS)
        normal[:, rows, columns] = normal[:, columns, rows] = sums[:, :_NORMAL]
        slope, exposure, error = np.split(sums[:, _NORMAL:], [NUMBERS, NUMBERS + _EXPOSURE], axis=1)
        return cls(normal, slope, exposure.reshape(-1, 3, 5), error[:, 0])


def camera_steps(
    normal: np.ndarray,
    slope: np.ndarray,
    lenses: np.ndarray,
    changes: np.ndarray | None = None,
    firmness: np.ndarray | float = 0.0,
) -> np.ndarray:
    """A damped step of Gauss-Newton (n, 7) for cameras of which some share a lens; J^T J (n, 7, 7) and J^T e (n, 7).
    changes: (n, 7) from the given cameras, None holds nothing; firmness: (n, 7) how firmly those hold beyond HOLD."""
    diagonal = np.einsum("nii->ni", normal)
    largest = diagonal.max(axis=1, keepdims=True)
    added = DAMPING * diagonal + LEAST_DAMPING * largest + TINY
    if changes is not None:
        hold = (HOLD + firmness) * largest
        slope, added = slope + hold * changes, added + hold
    raised = normal.copy()
    raised[:, np.arange(NUMBERS), np.arange(NUMBERS)] += added
    # The matrix is an arrow: six numbers of each camera by themselves, and those of the lenses with all. The cameras
    # are eliminated first (Schur's complement; Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6).
    crossing = raised[:, :6, 6:]
    solved = np.linalg.solve(raised[:, :6, :6], np.concatenate([slope[:, :6, None], crossing], axis=2))
    complement = raised[:, 6, 6] - (crossing[..., 0] * solved[..., 1]).sum(axis=1)
    remainder = slope[:, 6] - (crossing[..., 0] * solved[..., 0]).sum(axis=1)
    lens_steps = -np.bincount(lenses, remainder) / np.maximum(np.bincount(lenses, complement), TINY)
    along = lens_steps[lenses][:, None]
    return np.concatenate([-solved[..., 0] - solved[..., 1] * along, along], axis=1)


def fitted_exposures(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gains and offsets (n, 3) that make a field's colours those of its pictures, by exposure sums (n, 3, 5)."""
    # y = gain x + offset a, by least squares
    xx, xa, aa, xy, ay = np.moveaxis(sums, -1, 0)
    prior = EXPOSURE_PRIOR * aa + TINY
    xx, xy, aa = xx + prior, xy + prior, (1.0 + OFFSET_PRIOR) * aa + TINY
    determinant = np.maximum(xx * aa - xa * xa, TINY)
    gains = np.clip((aa * xy - xa * ay) / determinant, *GAINS)
    return gains, (xx * ay - xa * xy) / determinant


def even_exposures(gains: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exposures relative to their mean: what undoes them has the geometric mean 1 and the mean offset 0."""
    gains = gains / np.exp(np.log(gains).mean(axis=0))
    return gains, offsets - gains * (offsets / gains).mean(axis=0)
