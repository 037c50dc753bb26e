"""Which pictures are compared with which: all, or neighbours of a video and those that look alike."""

from __future__ import annotations

import numpy as np

#: Features of a picture by which likeness is judged: the largest ones, which other views show too (Wu 2013).
LARGEST = 300

#: A descriptor is the same as its nearest one where the second is farther by this ratio (Lowe 2004).
RATIO = 0.85

#: Fewer of these than this is chance.
LEAST_ALIKE = 5

#: Frames of a video are compared with this many after them, and besides with those at powers of two.
NEIGHBOURS = 10

#: Other pictures that each one is compared with, where not all are.
MOST_ALIKE = 20

#: Folders of so many pictures are compared whole.
SMALL_FOLDER = 32


def largest_features(scales: np.ndarray, descriptors: np.ndarray) -> np.ndarray:
    """Descriptors (n, 128) uint8 of the largest features of a picture, by their sizes (n,), as unit vectors.
    Returns (k, 128) float32, k at most LARGEST."""
    chosen = np.argsort(-scales, kind="stable")[:LARGEST]
    vectors = descriptors[chosen].astype(np.float32)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)


def likeness(first: np.ndarray, second: np.ndarray) -> int:
    """How many features of two pictures agree, each the other's nearest and clearly nearer than the next.
    They are unit vectors (k, 128) and (m, 128)."""
    if min(len(first), len(second)) < 2:
        return 0
    cosines = first @ second.T
    nearest, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    mutual = np.flatnonzero(back[nearest] == np.arange(len(first)))
    rows = cosines[mutual]
    two = np.partition(rows, -2, axis=1)[:, -2:]
    near, next_one = (np.sqrt(np.maximum(2.0 - 2.0 * two[:, k], 0.0)) for k in (1, 0))
    return int((near < RATIO * next_one).sum())


def neighbour_pairs(count: int) -> list[tuple[int, int]]:
    """Pairs of indices of frames, the smaller first: each with those that follow, and with some farther on."""
    steps = [*range(1, NEIGHBOURS + 1)]
    while steps[-1] * 2 < count:
        steps.append(steps[-1] * 2)
    return [(k, k + step) for k in range(count) for step in steps if k + step < count]


def chosen_pairs(features: list[np.ndarray], *, video: bool) -> list[tuple[int, int]]:
    """The pairs of indices of pictures, the smaller first, in order, that are worth comparing in full.
    features: of each picture (k, 128) unit vectors from `largest_features`; video: pictures follow one another."""
    # All of a small folder. Otherwise the pairs that look most alike, and neighbours in a video: so views are tied
    # together where the camera comes back to a place.
    count = len(features)
    every = [(a, b) for a in range(count) for b in range(a + 1, count)]
    if count <= SMALL_FOLDER and not video:
        return every
    alike = np.zeros((count, count), np.int32)
    for a, b in every:
        alike[a, b] = alike[b, a] = likeness(features[a], features[b])
    pairs = set(neighbour_pairs(count)) if video else set()
    most = MOST_ALIKE // 2 if video else MOST_ALIKE
    for a in range(count):
        best = np.argsort(-alike[a], kind="stable")[:most]
        pairs |= {(min(a, int(b)), max(a, int(b))) for b in best if alike[a, b] >= LEAST_ALIKE}
    return sorted(pairs)
