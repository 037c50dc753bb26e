"""Faces in the order in which kernels that take them edge by edge have least to do: in fans around vertices."""

from __future__ import annotations

import heapq

import numpy as np
import warp as wp

from .devices import launch
from .kernels.face_fans import prepare_fans


def fan_order(faces: np.ndarray) -> np.ndarray:
    """The triangles (f, 3) of a usable cage, turned and in an order in which most begin with an edge of the one before.

    Around a vertex a, (a, b, c) is followed by (a, c, d), and so on: a fan. Vertices with most faces left come first,
    so that there are few fans: about f / 4 on closed cages.
    """
    faces = np.asarray(faces)
    following = [{} for _ in range(int(faces.max()) + 1)]  # c by b, of the faces left around a
    for a, b, c in faces.tolist():
        following[a][b], following[b][c], following[c][a] = c, a, b
    heap = [(-len(around), hub) for hub, around in enumerate(following) if around]
    heapq.heapify(heap)
    ordered = []
    while heap:
        count, hub = heapq.heappop(heap)
        around = following[hub]
        if -count != len(around):  # others have taken faces since
            if around:
                heapq.heappush(heap, (-len(around), hub))
            continue
        starts = set(around) - set(around.values())
        while around:
            b = min(starts) if starts else min(around)
            starts.discard(b)
            while b in around:
                c = around.pop(b)
                del following[b][c], following[c][hub]
                ordered.append((hub, b, c))
                b = c
    return np.array(ordered, dtype=faces.dtype)


def prepared_fans(vertices: wp.array, faces: wp.array, size: float, out: wp.array | None = None) -> wp.array:
    """What `mean_value_position` reads of faces (f,) vec3i over vertices (v,) vec3, on their device; see the kernel.

    size: of the cage, in the vertices' units. out: (2 f,) vec4 to be filled instead of a new array.
    """
    fans = wp.empty(2 * faces.size, dtype=wp.vec4, device=faces.device) if out is None else out
    launch(prepare_fans, faces.size, [vertices, faces, size], [fans], device=faces.device)
    return fans
