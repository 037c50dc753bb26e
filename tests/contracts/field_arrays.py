"""Arrays of field files of every version, written by hand as the readers document them."""

import numpy as np


def field_arrays(version):
    """The arrays of a warpcage field: version 1 plain, 2 with background layers, 3 luminous, 4 with an outer field."""
    random, side = np.random.default_rng(version), 6
    places = (np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1) + 0.5) / side * 2 - 1
    occupied = np.linalg.norm(places / [0.9, 0.8, 0.7], axis=-1) < 1.1
    rows = int(occupied.sum())
    luminous = version >= 3
    numbers = (rows, 24) if luminous else (rows, 3, 9)
    sh = (random.normal(size=numbers) * 0.3).astype(np.float16)
    density = (8.0 * random.random(rows)).astype(np.float32)
    bounds = np.array([[-1.0, -0.9, -0.8], [1.0, 0.9, 0.8]]) + [0.25, -0.5, 0.125]
    arrays = {
        "format": np.array("warpcage"),
        "version": np.array(version),
        "bounds": bounds,
        "resolution": np.array([side] * 3, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
    }
    turn = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    turn[:3, 3] = [0.5, 0.25, -1]
    arrays |= {
        "density": density,
        "sh": sh,
        "background": np.array([0.2, 0.4, 0.6], np.float32),
        "up": np.array([0.0, 0.6, 0.8]),
        "supersampling": np.array(2),
        "straightening": turn,
        "weights": random.random(rows).astype(np.float16),
    }
    if version == 2:
        nodes = 6 * 3**2 + 2
        seen = random.random((2, nodes)) < 0.8
        arrays |= {
            "layers_center": bounds.mean(axis=0),
            "layers_half": np.array(1.5),
            "layers_side": np.array(3),
            "layers_count": np.array(2),
            "layers_seen": np.packbits(seen.ravel()),
            "layers_rgba": random.integers(0, 200, (int(seen.sum()), 4)).astype(np.uint8),
            "layers_unseen": np.array([0.5, 0.5, 0.5, 0.1], np.float32),
        }
    if version == 4:
        around = random.random((8, 8, 8)) < 0.4
        around[2:6, 2:6, 2:6] = False
        arrays |= {
            "outer_center": bounds.mean(axis=0),
            "outer_half": 0.5 * np.ptp(bounds, axis=0),
            "outer_side": np.array(8),
            "outer_occupancy": np.packbits(around.ravel()),
            "outer_rgba": random.integers(0, 200, (int(around.sum()), 4)).astype(np.uint8),
            "outer_sky": random.integers(0, 256, (6 * 3**2 + 2, 3)).astype(np.uint8),
        }
    return arrays
