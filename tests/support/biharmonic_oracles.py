"""Biharmonic coordinates in float64: layers in closed form and by quadrature, the equations by differences."""

import numpy as np

#: Places inside of the middle of a face, in sizes of the cage, from which values and slopes on it are extrapolated.
STEPS = 5e-4 * np.arange(1, 8)


def normals_of(corners):
    """Unit normals (f, 3) of triangles (f, 3, 3)."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


def layers(points, corners):
    """phi (n, f, 3), psi, D and S (n, f) of triangles (f, 3, 3), off their planes or clear of them."""
    p = corners[None] - np.asarray(points, np.float64)[:, None, None]
    r = np.linalg.norm(p, axis=3)
    normal = normals_of(corners)
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    height = np.einsum("nfc,fc->nf", p[:, :, 0], normal)
    below, logs, reaches, rims, outward, lengths = r.prod(axis=2), [], [], [], [], []
    for k in range(3):
        one, two = (k + 1) % 3, (k + 2) % 3
        along = corners[:, two] - corners[:, one]
        length = np.linalg.norm(along, axis=1)
        along = along / length[:, None]
        out = np.cross(along, normal)
        begin, end = (np.einsum("nfc,fc->nf", p[:, :, at], along) for at in (one, two))
        across = np.einsum("nfc,nfc->nf", p[:, :, one], p[:, :, one]) - begin**2
        log = 2 * np.arctanh(length / (r[:, :, one] + r[:, :, two]))
        reaches.append((end * r[:, :, two] - begin * r[:, :, one] + across * log) / 2)
        logs.append(log)
        rims.append(np.einsum("nfc,fc->nf", p[:, :, one], out))
        outward.append(out)
        lengths.append(length)
        below = below + np.einsum("nfc,nfc->nf", p[:, :, one], p[:, :, two]) * r[:, :, k]
    angle = 2 * np.arctan2(height * double_area, below)
    first = sum(rim * log for rim, log in zip(rims, logs, strict=True)) - height * angle
    reach = sum(rim * each for rim, each in zip(rims, reaches, strict=True))
    pull = sum(log[:, :, None] * out for log, out in zip(logs, outward, strict=True))
    phi = [
        rim * length / double_area * angle + height * (length / double_area) * np.einsum("nfc,fc->nf", pull, out)
        for rim, length, out in zip(rims, lengths, outward, strict=True)
    ]
    second, third = -height * first / (8 * np.pi), (reach + height**2 * first) / (24 * np.pi)
    return np.stack(phi, axis=2) / (4 * np.pi), first / (4 * np.pi), second, third


def layers_by_quadrature(points, corners, count=40):
    """The integrals that define them, by Gauss's rule on each triangle (points clear of it)."""
    places, weights = np.polynomial.legendre.leggauss(count)
    u, v = np.meshgrid((places + 1) / 2, (places + 1) / 2, indexing="ij")
    hats = np.stack([1 - u, u * (1 - v), u * v], axis=2).reshape(-1, 3)
    weight = (np.outer(weights, weights) * u).ravel() / 4
    weight = (
        weight * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)[:, None]
    )
    away = np.einsum("qk,fkc->fqc", hats, corners)[None] - np.asarray(points, np.float64)[:, None, None]
    r = np.linalg.norm(away, axis=3)
    facing = np.einsum("nfqc,fc->nfq", away, normals_of(corners))
    phi = np.einsum("nfq,fq,qk->nfk", facing / r**3, weight, hats) / (4 * np.pi)
    psi, second, third = (
        np.einsum("nfq,fq->nf", each, weight)
        for each in (1 / r / (4 * np.pi), -facing / r / (8 * np.pi), r / 8 / np.pi)
    )
    return phi, psi, second, third


def layer_rows(points, vertices, faces):
    """What values at vertices and slopes multiply (n, v + f), and Laplacians and their slopes (n, 2 f)."""
    phi, psi, second, third = layers(points, vertices[faces])
    hats = np.zeros((len(points), len(vertices)))
    for k in range(3):
        np.add.at(hats.T, faces[:, k], phi[:, :, k].T)
    return np.concatenate([hats, psi], axis=1), np.concatenate([second, third], axis=1)


def biharmonic_equations(vertices, faces):
    """The equations at the middles of faces, known (2 f, v + f) and unknown (2 f, 2 f): values, then slopes along the
    normal, by the polynomial through places inside. The cage is of size one."""
    corners = vertices[faces]
    middles, normal = corners.mean(axis=1), normals_of(corners)
    rows = [layer_rows(middles - step * normal, vertices, faces) for step in STEPS]
    scaled = STEPS / STEPS[-1]
    fit = np.linalg.inv(np.vander(scaled, increasing=True))[:2]  # the value at 0, and the slope inward
    return [
        np.concatenate([np.tensordot(fit[0], each, 1), -np.tensordot(fit[1], each, 1) / STEPS[-1]])
        for each in (np.stack(parts) for parts in zip(*rows, strict=True))
    ]


def biharmonic_weights(points, vertices, faces):
    """Weights of vertices (n, v) and of faces (n, f), which are lengths, of points inside."""
    vertices = np.asarray(vertices, np.float64)
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    center, size = (lower + upper) / 2, (upper - lower).max()
    vertices, points = (vertices - center) / size, (np.asarray(points, np.float64) - center) / size
    corners, count = len(vertices), len(faces)
    known, unknown = biharmonic_equations(vertices, faces)
    sides = -known
    for k in range(3):
        np.add.at(sides, (np.arange(count), faces[:, k]), 1 / 3)
    sides[count + np.arange(count), corners + np.arange(count)] += 1
    green, more = layer_rows(points, vertices, faces)
    weights = green + more @ np.linalg.solve(unknown, sides)
    return weights[:, :corners], weights[:, corners:] * size
