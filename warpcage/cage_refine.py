"""Edit a cage by hand: divide it, take vertices away without uncovering the object, make it symmetric."""

from __future__ import annotations

import numpy as np

from .cage import Cage


def subdivided(cage: Cage, times: int = 1) -> Cage:
    """Every face cut in four at the middles of its edges, `times` times; the surface stays where it is.

    The vertices of the cage keep their numbers, new ones follow. Raises ValueError for times outside 1 .. 4.
    """
    if not isinstance(times, int | np.integer) or not 1 <= times <= 4:
        raise ValueError(f"times must be 1 to 4, got {times!r}")
    vertices, faces = cage.vertices, cage.faces.astype(np.int64)
    for _ in range(times):
        pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, middle = np.unique(pairs, axis=0, return_inverse=True)
        ab, bc, ca = middle.reshape(3, -1) + len(vertices)
        a, b, c = faces.T
        faces = np.concatenate([np.stack(corner, axis=1) for corner in
                                ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
    return Cage(vertices, faces)


def simplified(cage: Cage, vertex_count: int, *, field=None, mesh=None, margin: float = 0.0) -> Cage:
    """About `vertex_count` vertices (within a tenth) that enclose what the cage encloses: decimated so that the surface
    only moves outward (`warpcage.cage_nested`), then off the object where faces come too near to it.

    field, mesh: what must stay enclosed, visible voxels or vertices and points on faces; without either it is the cage
    itself, so that the simpler one lies around it. margin: least distance to it, world units.
    Raises ValueError for a cage that is not usable, a count not below the cage's, an object that is not enclosed
    before, or where no such cage is found.
    """
    from .cage_generation import checked_count, surface_points, visible_nodes
    from .cage_offset import simplified_cage

    cage.require_usable("the cage")
    vertex_count = checked_count(vertex_count)
    if vertex_count >= len(cage.vertices):
        raise ValueError(f"the cage has {len(cage.vertices)} vertices already: ask for fewer, got {vertex_count}")
    if not (np.isfinite(margin) and margin >= 0.0):
        raise ValueError(f"margin must be finite and not negative, got {margin}")
    thing = cage if mesh is None and field is None else mesh
    spacing, slack, points = cage.size / 96.0, 0.0, []
    if thing is not None:
        vertices, faces = np.asarray(thing.vertices, dtype=np.float64), np.asarray(thing.faces, dtype=np.int64)
        points += [vertices, surface_points(vertices, faces, 0.5 * spacing)]
        slack = 0.29 * spacing  # how far a face may lie off the points on it
    if field is not None:
        points.append(visible_nodes(field))
        spacing = max(spacing, float(np.max(field.voxel_size)))
        slack = max(slack, 0.5 * float(np.linalg.norm(np.broadcast_to(field.voxel_size, 3))))
    points = np.concatenate(points)
    if not len(points):
        raise ValueError("there is nothing to enclose: the object is empty")
    if thing is not cage and not np.asarray(cage.contains(points)).all():
        raise ValueError("the cage does not enclose the object even before: check(field=...) says where")
    return simplified_cage(cage.vertices, cage.faces, points, spacing, slack + margin, vertex_count)


def symmetrised(cage: Cage, axis: str = "x", *, centre: float | None = None, keep: str = "both") -> Cage:
    """Vertices moved so that the cage is its own mirror image across the plane at `centre` along `axis`.

    The cage must be nearly symmetric already: each vertex is paired with the one nearest to its mirror image. centre:
    world units, the middle of the bounding box by default. keep: "both" takes means, "+" or "-" copies the half on that
    side to the other. Faces stay; squares may be cut along other diagonals on both sides.
    Raises ValueError where the vertices do not pair, or for other names.
    """
    from .poses import axis_index

    along = axis_index(axis)
    if keep not in ("both", "+", "-"):
        raise ValueError(f"keep must be 'both', '+' or '-', got {keep!r}")
    middle = float(cage.bounds[:, along].mean()) if centre is None else float(centre)
    if not np.isfinite(middle):
        raise ValueError(f"centre must be finite, got {centre}")
    own = cage.vertices
    mirrored = own.copy()
    mirrored[:, along] = 2.0 * middle - mirrored[:, along]
    partner = np.array([np.argmin(((own - image) ** 2).sum(axis=1)) for image in mirrored])
    alone = np.flatnonzero(partner[partner] != np.arange(len(own)))
    if len(alone):
        raise ValueError(f"{len(alone)} vertices have no partner across the plane {axis} = {middle:.4g}, the first "
                         f"{alone[0]}: move the plane with centre, or make the cage with symmetry={axis!r}")
    across = mirrored[partner]
    if keep == "both":
        return cage.with_vertices(0.5 * (own + across))
    side = (own[:, along] >= middle) == (keep == "+")
    middle_ones = partner == np.arange(len(own))
    kept = np.where(side[:, None], own, across)
    return cage.with_vertices(np.where(middle_ones[:, None], 0.5 * (own + across), kept))
