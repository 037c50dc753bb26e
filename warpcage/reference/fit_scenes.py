"""Small scenes of several kinds that the project makes itself: whether a fit's defaults suit more than one object."""

from __future__ import annotations

import numpy as np

from ..scene.scene import Scene
from ..view.camera import Camera
from .brick_scene import CAMERA_ANGLE_X, _orbit_eyes, _spread_eyes
from .bricks import brick_model
from .raycast import render_mesh_views
from .solids import _box, _cylinder

#: Side of the squares of the textured model's pattern, world units.
PATTERN = 0.11


def thin_model():
    """A wire globe on a lattice mast, of rods a fiftieth of the model thick. Returns as brick_model does."""
    parts, rod = [], 0.02
    turn = 2 * np.pi * np.arange(28) / 28

    def ring(points, colour):
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            parts.append(_cylinder(start, end, rod, colour, segments=8))

    globe = np.array([0.0, 0.0, 0.35])
    for tilt, colour in ((0, (0.8, 0.15, 0.1)), (60, (0.1, 0.3, 0.75)), (120, (0.15, 0.55, 0.25))):
        c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
        ring(globe + 0.62 * np.stack([c * np.cos(turn), s * np.cos(turn), np.sin(turn)], axis=1), colour)
    ring(globe + 0.62 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1), (0.9, 0.7, 0.1))
    feet = np.array([[0.3, 0.3], [-0.3, 0.3], [-0.3, -0.3], [0.3, -0.3]])
    levels = ((-0.95, 1.0), (-0.6, 0.7), (-0.27, 0.3))
    for (low, wide), (high, narrow) in zip(levels, levels[1:], strict=False):
        for i in range(4):
            foot, head = np.append(wide * feet[i], low), np.append(narrow * feet[i], high)
            across = np.append(narrow * feet[(i + 1) % 4], high)
            for end in (head, across):
                parts.append(_cylinder(foot, end, rod, (0.25, 0.25, 0.28), segments=8))
            parts.append(_cylinder(head, across, rod, (0.25, 0.25, 0.28), segments=8))
    parts.append(_box((-0.4, -0.4, -1.0), (0.4, 0.4, -0.95), (0.5, 0.48, 0.45)))
    return _joined(parts)


def specular_model():
    """Three balls on a plate, to be rendered with strong highlights. Returns as brick_model does."""
    balls = (
        ((-0.35, 0.25, -0.05), 0.45, (0.6, 0.06, 0.05)),
        ((0.45, 0.1, -0.15), 0.35, (0.05, 0.15, 0.5)),
        ((0.1, -0.5, -0.22), 0.28, (0.1, 0.1, 0.1)),
    )
    parts = [_ball(*ball) for ball in balls]
    return _joined([*parts, _box((-0.95, -0.95, -0.6), (0.95, 0.95, -0.5), (0.45, 0.42, 0.38))])


def textured_model():
    """A block and a ball whose faces each have a colour at random, a pattern of a few pixels a side. As brick_model."""
    random = np.random.default_rng(5)
    block = _quilt((-0.75, -0.55, -0.7), (0.75, 0.55, 0.2))
    ball_vertices, ball_faces, _ = _ball((0.1, 0.0, 0.5), 0.45, (1, 1, 1), subdivisions=3)
    vertices, faces, _ = _joined([block, (ball_vertices, ball_faces, (1, 1, 1))])
    colours = random.uniform(0.05, 0.95, faces.shape).astype(np.float32)
    quilted = len(block[1])
    colours[1:quilted:2] = colours[:quilted:2]  # both triangles of a square
    return vertices, faces, colours


MODELS = {"bricks": brick_model, "thin": thin_model, "specular": specular_model, "textured": textured_model}
LIGHTS = {"specular": {"highlight": 1.2, "shininess": 60.0}}

#: name -> model, number of training views (None: as asked), scale, shift of the object and cameras, and of the object
#: against what the cameras look at, in units of the model
KINDS = {
    "bricks": ("bricks", None, 1.0, (0, 0, 0), (0, 0, 0)),
    "thin": ("thin", None, 1.0, (0, 0, 0), (0, 0, 0)),
    "specular": ("specular", None, 1.0, (0, 0, 0), (0, 0, 0)),
    "textured": ("textured", None, 1.0, (0, 0, 0), (0, 0, 0)),
    "off-centre": ("bricks", None, 1.0, (70, -50, 30), (0, 0, 0)),
    "aside": ("bricks", None, 1.0, (0, 0, 0), (0.25, -0.2, 0.15)),
    "ten times larger": ("bricks", None, 10.0, (0, 0, 0), (0, 0, 0)),
    "20 views": ("bricks", 20, 1.0, (0, 0, 0), (0, 0, 0)),
    "20 views, thin": ("thin", 20, 1.0, (0, 0, 0), (0, 0, 0)),
    "20 views, specular": ("specular", 20, 1.0, (0, 0, 0), (0, 0, 0)),
    "20 views, textured": ("textured", 20, 1.0, (0, 0, 0), (0, 0, 0)),
}


def synthetic_scene(
    kind: str = "bricks",
    *,
    train_views: int = 60,
    test_views: int = 8,
    size: int = 100,
    seed: int = 0,
    samples: int = 3,
    alpha: bool = True,
    device=None,
) -> tuple[Scene, Scene]:
    """Training and test views of one of KINDS, white background.

    train_views: of the kinds that do not fix it; size: pixels a side; samples x samples rays a pixel; seed: places the
    training cameras; alpha: whether the scenes have alphas. The cameras lie on the upper hemisphere, 4 units of the
    model from what they look at. Raises ValueError for a kind that is not known and counts below one.
    """
    if kind not in KINDS:
        raise ValueError(f"scene kind {kind!r} is not known: {', '.join(KINDS)}")
    if min(train_views, test_views, size) < 1:
        raise ValueError(f"a scene needs views and pixels, got {train_views} + {test_views} views of {size} pixels")
    model, view_count, scale, shift, aside = KINDS[kind]
    vertices, faces, colours = MODELS[model]()
    scenes = []
    for eyes in (_spread_eyes(view_count or train_views, seed), _orbit_eyes(test_views)):
        target = scale * np.asarray(shift, np.float64)
        cameras = [
            Camera.look_at(
                target + scale * eye, target, fov_degrees=np.degrees(CAMERA_ANGLE_X), width=size, height=size
            )
            for eye in eyes
        ]
        rgba = render_mesh_views(
            scale * (vertices + shift + aside),
            faces,
            colours,
            cameras,
            samples=samples,
            device=device,
            **LIGHTS.get(model, {}),
        )
        alphas = rgba[..., 3]
        images = rgba[..., :3] * alphas[..., None] + (1.0 - alphas[..., None])
        scenes.append(Scene(images, alphas if alpha else None, cameras))
    return scenes[0], scenes[1]


def _joined(parts):
    """One mesh of (vertices, faces, colour) parts."""
    counts = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts])
    vertices = np.concatenate([vertices for vertices, _, _ in parts])
    faces = np.concatenate([faces + first for (_, faces, _), first in zip(parts, counts[:-1], strict=True)])
    colours = np.concatenate([np.broadcast_to(colour, faces.shape) for _, faces, colour in parts])
    return vertices, faces.astype(np.int32), colours.astype(np.float32)


def _ball(centre, radius, colour, *, subdivisions: int = 4):
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(sphere.vertices) + centre, np.asarray(sphere.faces), colour


def _quilt(low, high):
    """A box whose sides are cut into squares of about PATTERN; both triangles of a square follow each other."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    vertices, faces = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        counts = [int(np.ceil((high[i] - low[i]) / PATTERN)) for i in (u, v)]
        a, b = np.meshgrid(np.linspace(0, 1, counts[0] + 1), np.linspace(0, 1, counts[1] + 1), indexing="ij")
        corner = np.arange(counts[0] * (counts[1] + 1)).reshape(counts[0], -1)[:, :-1].ravel()
        row = counts[1] + 1
        for end in (0, 1):
            points = np.empty((a.size, 3))
            points[:, axis] = (low, high)[end][axis]
            points[:, u] = low[u] + a.ravel() * (high[u] - low[u])
            points[:, v] = low[v] + b.ravel() * (high[v] - low[v])
            first, second = (corner, corner + row, corner + row + 1), (corner, corner + row + 1, corner + 1)
            sides = np.stack([np.stack(first, axis=1), np.stack(second, axis=1)], axis=1).reshape(-1, 3)
            faces.append((sides if end else sides[:, ::-1]) + sum(map(len, vertices)))
            vertices.append(points)
    return np.concatenate(vertices), np.concatenate(faces), (1.0, 1.0, 1.0)
