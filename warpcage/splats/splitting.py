"""Splats in pieces: three Gaussians along an axis that look like the one that they are pieces of."""

from __future__ import annotations

import dataclasses

import numpy as np

#: Standard deviation of a piece along the axis that is cut, in those of the whole.
PIECE = 0.65

#: Least squares over the picture of a splat seen from the side, alphas composited: opacity of the whole; of the piece
#: in the middle; of the two at the sides; their distance from it, in standard deviations of the whole; and how much
#: narrower the pieces are across. Worst errors of alpha: 0.0015 at 0.1, 0.011 at 0.5, 0.046 at 0.99.
_TABLE = np.array(
    [
        (0.0, 0.0, 0.0, 1.0493, 1.0),
        (0.1, 0.0827, 0.0359, 1.0400, 0.9953),
        (0.2, 0.1675, 0.0730, 1.0306, 0.9904),
        (0.3, 0.2551, 0.1114, 1.0210, 0.9851),
        (0.4, 0.3459, 0.1511, 1.0114, 0.9793),
        (0.5, 0.4406, 0.1923, 1.0017, 0.9732),
        (0.6, 0.5401, 0.2350, 0.9921, 0.9666),
        (0.7, 0.6455, 0.2791, 0.9826, 0.9596),
        (0.8, 0.7580, 0.3248, 0.9735, 0.9520),
        (0.9, 0.8792, 0.3720, 0.9649, 0.9438),
        (0.95, 0.9437, 0.3960, 0.9609, 0.9396),
        (1.0, 1.0, 0.4215, 0.9570, 0.9352),
    ]
)

#: Pieces of pieces are cut no more often than this.
MOST_CUTS = 4


@dataclasses.dataclass(frozen=True)
class SplitTree:
    """Splats and their pieces. A node is a splat or a piece."""

    rows: np.ndarray  # (nodes,) the splat that each node is, or is a piece of
    parents: np.ndarray  # (nodes,) the node that each is a piece of, -1 for splats
    pieces: np.ndarray  # (nodes,) the first of the three pieces of each node, -1 for those that are not cut
    centres: np.ndarray  # (nodes, 3) world units
    factors: np.ndarray  # (nodes, 3, 3) axes times standard deviations, one per column
    opacities: np.ndarray  # (nodes,) 0 to 1

    @property
    def covariances(self) -> np.ndarray:
        """(nodes, 3, 3) world units squared."""
        return self.factors @ self.factors.transpose(0, 2, 1)


def pieces_of(
    centres: np.ndarray, factors: np.ndarray, opacities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three pieces of each splat along its longest axis, the middle one first, which together look like it.
    Arrays as in `SplitTree`, (n, ...); those returned are centres (n, 3, 3), factors (n, 3, 3, 3), opacities (n, 3)."""
    middle, side, distance, across = (np.interp(opacities, _TABLE[:, 0], column) for column in _TABLE[:, 1:].T)
    longest = np.argmax((factors**2).sum(axis=1), axis=1)
    rows = np.arange(len(centres))
    axis = factors[rows, :, longest] * distance[:, None]
    cut = factors * across[:, None, None]
    cut[rows, :, longest] = PIECE * factors[rows, :, longest]
    return (
        np.stack([centres, centres - axis, centres + axis], axis=1),
        np.repeat(cut[:, None], 3, axis=1),
        np.stack([middle, side, side], axis=1),
    )


def split_tree(
    centres: np.ndarray,
    factors: np.ndarray,
    opacities: np.ndarray,
    largest: np.ndarray,
    cuts: int = MOST_CUTS,
    most: int | None = None,  # None is no limit
) -> SplitTree:
    """Splats, the first n nodes, and pieces of those, or of pieces, of a standard deviation above `largest` (n,).
    Arrays as in `SplitTree`; cuts: how often at most; most: nodes at most, the largest are cut first."""
    count = len(centres)
    nodes = [(np.arange(count), np.full(count, -1), centres, factors, opacities)]
    pieces = [np.full(count, -1)]
    begin, total = 0, count
    for _ in range(cuts):
        rows, _, places, axes, alphas = nodes[-1]
        excess = np.sqrt((axes**2).sum(axis=1).max(axis=1, initial=0.0)) / largest[rows]
        cut = np.flatnonzero(excess > 1.0)
        if most is not None:
            room = max(0, (most - total) // 3)
            cut = np.sort(cut[np.argsort(-excess[cut], kind="stable")[:room]])
        if not len(cut):
            break
        pieces[-1][cut] = total + 3 * np.arange(len(cut))
        new_places, new_axes, new_alphas = pieces_of(places[cut], axes[cut], alphas[cut])
        parents = np.repeat(begin + cut, 3)
        flat = (new_places.reshape(-1, 3), new_axes.reshape(-1, 3, 3), new_alphas.reshape(-1))
        nodes.append((np.repeat(rows[cut], 3), parents, *flat))
        pieces.append(np.full(3 * len(cut), -1))
        begin, total = total, total + 3 * len(cut)
    rows, parents, places, axes, alphas = (np.concatenate(parts) for parts in zip(*nodes, strict=True))
    return SplitTree(rows, parents, np.concatenate(pieces), places, axes, alphas)
