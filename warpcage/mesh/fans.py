"""Faces in fans around vertices: the order in which kernels that take them edge by edge have least to do."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..core.devices import launch
from ..kernels.mesh.fans import prepare_fans


@dataclass(frozen=True)
class FaceFans:
    """Triangles turned and ordered so that most begin with an edge of the one before.
    Around a vertex a, (a, c, d) follows (a, b, c), and so on."""

    faces: np.ndarray  # (f, 3) int32 indices of vertices
    order: np.ndarray  # (f,) int: which face of the mesh each of them is


def face_fans(faces: np.ndarray) -> FaceFans:
    """The triangles (f, 3) of a usable mesh in few fans, about f / 4."""
    faces = np.asarray(faces)
    # of the faces left around a: c and the face's number by b
    following: list[dict[int, tuple[int, int]]] = [{} for _ in range(int(faces.max()) + 1)]
    for f, (a, b, c) in enumerate(faces.tolist()):
        following[a][b], following[b][c], following[c][a] = (c, f), (a, f), (b, f)
    heap = [(-len(around), hub) for hub, around in enumerate(following) if around]  # those with most faces left first
    heapq.heapify(heap)
    turned, order = [], []
    while heap:
        count, hub = heapq.heappop(heap)
        around = following[hub]
        if -count != len(around):  # others have taken faces since
            if around:
                heapq.heappush(heap, (-len(around), hub))
            continue
        starts = set(around) - {c for c, _ in around.values()}
        while around:
            b = min(starts) if starts else min(around)
            starts.discard(b)
            while b in around:
                c, f = around.pop(b)
                del following[b][c], following[c][hub]
                turned.append((hub, b, c))
                order.append(f)
                b = c
    return FaceFans(np.array(turned, dtype=np.int32), np.array(order))


def prepared_fans(vertices: wp.array, faces: wp.array, size: float, out: wp.array | None = None) -> wp.array:
    """What closed forms read of faces (f,) vec3i in the order of `face_fans`, see the kernel `prepare_fans`: (2 f,)
    vec4. size: of the mesh, in the vertices' unit; out: filled, None makes a new array."""
    fans = wp.empty(2 * faces.size, dtype=wp.vec4, device=faces.device) if out is None else out  # pyright: ignore[reportArgumentType]
    launch(prepare_fans, faces.size, [vertices, faces, size], [fans], device=faces.device)
    return fans
