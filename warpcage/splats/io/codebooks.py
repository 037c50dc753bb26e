"""Few values that stand for many: codebooks of 256 numbers, and palettes of vectors."""

from __future__ import annotations

import numpy as np

#: Numbers of a codebook.
CODES = 256

#: Rounds in which the numbers of a codebook move to the middle of what they stand for.
_ROUNDS = 40


def codebook(values: np.ndarray) -> np.ndarray:
    """(256,) float64, rising: the numbers that stand for values of any shape with a small mean squared difference."""
    flat = np.sort(values.astype(np.float64), axis=None)
    distinct = np.unique(flat)
    if len(distinct) <= CODES:  # each value is a number itself
        return np.concatenate([distinct, np.full(CODES - len(distinct), distinct[-1] if len(distinct) else 0.0)])
    # half of them where the values are, half evenly over their range, so that few far values have one near; then
    # Lloyd's rounds, for which sums over the sorted values are differences of running sums
    share = np.linspace(0.0, 1.0, CODES // 2)
    codes = np.sort(np.concatenate([np.quantile(flat, share), flat[0] + share * (flat[-1] - flat[0])]))
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(_ROUNDS):
        ends = np.searchsorted(flat, 0.5 * (codes[1:] + codes[:-1]))
        begins, ends = np.concatenate([[0], ends]), np.concatenate([ends, [len(flat)]])
        counts = ends - begins
        means = (sums[ends] - sums[begins]) / np.maximum(counts, 1)
        moved = np.sort(np.where(counts > 0, means, codes))
        if np.array_equal(moved, codes):
            break
        codes = moved
    return codes


def nearest(codes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The place (uint8) of the nearest number of a rising codebook, for values of any shape."""
    return np.searchsorted(0.5 * (codes[1:] + codes[:-1]), values.astype(np.float64)).astype(np.uint8)


def palette(vectors: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `most` vectors (k, d) float64 that stand for vectors (n, d), and which stands for each (n,) int64.
    Up to `most` of them are all their own."""
    vectors = vectors.astype(np.float64)
    count = len(vectors)
    if count <= most:
        return vectors, np.arange(count)
    # cells are halved at the middle of the direction in which they are widest, all of one level at once
    labels, cells = np.zeros(count, np.int64), 1
    while 2 * cells <= most:
        sizes = np.bincount(labels, minlength=cells)
        spread = np.empty((cells, vectors.shape[1]))
        for k in range(vectors.shape[1]):
            mean = np.bincount(labels, vectors[:, k], cells) / np.maximum(sizes, 1)
            spread[:, k] = np.bincount(labels, (vectors[:, k] - mean[labels]) ** 2, cells)
        along = vectors[np.arange(count), spread.argmax(axis=1)[labels]]
        order = np.lexsort((along, labels))
        begins = np.cumsum(sizes) - sizes
        rank = np.empty(count, np.int64)
        rank[order] = np.arange(count) - begins[labels[order]]
        labels = 2 * labels + (rank >= (sizes[labels] + 1) // 2)
        cells *= 2
    used, labels = np.unique(labels, return_inverse=True)
    sizes = np.bincount(labels, minlength=len(used))
    means = [np.bincount(labels, vectors[:, k], len(used)) / sizes for k in range(vectors.shape[1])]
    return np.stack(means, axis=1), labels
