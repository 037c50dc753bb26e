"""Small scenes of several kinds, to see whether the defaults of a fit suit more than one object."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from ..scene.scene import Scene
from .models import MODELS
from .raycast import render_mesh_views
from .viewpoints import orbit_eyes, reference_cameras, require_counts, spread_eyes

Vector = tuple[float, float, float]

#: Model -> options of render_mesh_views.
LIGHTS = {"specular": {"highlight": 1.2, "shininess": 60.0}}


@dataclasses.dataclass(frozen=True)
class SceneKind:
    """A model and how it is seen."""

    model: str  # one of `MODELS`
    view_count: int | None = None  # training views; None is what the caller asks for
    scale: float = 1.0  # of the model and of the distances of the cameras
    shift: Vector = (0, 0, 0)  # moves the object and the cameras together, in units of the model
    aside: Vector = (0, 0, 0)  # moves the object away from what the cameras look at, in units of the model


#: Kinds of scenes by name.
KINDS = {
    "bricks": SceneKind("bricks"),
    "thin": SceneKind("thin"),
    "specular": SceneKind("specular"),
    "textured": SceneKind("textured"),
    "off-centre": SceneKind("bricks", shift=(70, -50, 30)),
    "aside": SceneKind("bricks", aside=(0.25, -0.2, 0.15)),
    "ten times larger": SceneKind("bricks", scale=10.0),
    "20 views": SceneKind("bricks", view_count=20),
    "20 views, thin": SceneKind("thin", view_count=20),
    "20 views, specular": SceneKind("specular", view_count=20),
    "20 views, textured": SceneKind("textured", view_count=20),
}


def synthetic_scene(
    kind: str = "bricks",
    *,
    train_views: int = 60,  # for kinds that do not fix it
    test_views: int = 8,
    size: int = 100,  # pixels along each side of a picture
    seed: int = 0,  # places the training cameras
    samples: int = 3,  # rays along each side of a pixel
    alpha: bool = True,  # whether the scenes have alphas
    device: wp.DeviceLike = None,
) -> tuple[Scene, Scene]:
    """Training and test views of one of `KINDS` on white."""
    # The cameras lie on the upper hemisphere, 4 units of the model from what they look at.
    if kind not in KINDS:
        raise ValueError(f"scene kind {kind!r} is not known: {', '.join(KINDS)}")
    require_counts(train_views, test_views, size)
    chosen = KINDS[kind]
    vertices, faces, colours = MODELS[chosen.model]()
    vertices = chosen.scale * (vertices + chosen.shift + chosen.aside)
    target = chosen.scale * np.asarray(chosen.shift, np.float64)
    light = LIGHTS.get(chosen.model, {})

    def scene(eyes: np.ndarray) -> Scene:
        cameras = reference_cameras(target + chosen.scale * eyes, target, size)
        rgba = render_mesh_views(vertices, faces, colours, cameras, samples=samples, device=device, **light)
        alphas = rgba[..., 3]
        images = rgba[..., :3] * alphas[..., None] + (1.0 - alphas[..., None])
        return Scene(images, alphas if alpha else None, cameras)

    return scene(spread_eyes(chosen.view_count or train_views, seed)), scene(orbit_eyes(test_views))
