"""The reference models by name."""

from __future__ import annotations

import numpy as np

from .animal import animal_model
from .bricks import brick_model
from .rods import chair_model, globe_model
from .solids import Model
from .surfaces import specular_model, textured_model

#: Models by name: functions that return vertices, faces and colours.
MODELS = {
    "bricks": brick_model,
    "animal": animal_model,
    "chair": chair_model,
    "thin": globe_model,
    "specular": specular_model,
    "textured": textured_model,
}


def subdivided_model(name: str, longest_edge: float) -> Model:
    """A model whose triangles are halved until none is longer than `longest_edge`, to follow a deformation."""
    import trimesh

    if name not in MODELS:
        raise ValueError(f"model {name!r} is not known: {', '.join(MODELS)}")
    vertices, faces, colours = MODELS[name]()
    vertices, faces, source = trimesh.remesh.subdivide_to_size(vertices, faces, longest_edge, return_index=True)  # pyright: ignore[reportAssignmentType]
    return np.asarray(vertices), faces.astype(np.int32), colours[source]
