"""`warpcage mesh`: extract the surface of a field."""

from __future__ import annotations

import argparse

from ..core.files import atomic_path
from . import inputs, options

#: Takes (x, y, z) to (x, z, -y): glTF has y up, while the other formats take coordinates as they are.
TO_Y_UP = ((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, options.MESH_ENDINGS, "mesh file")
    field = inputs.read_field(args)

    mesh = field.extract_mesh(threshold=args.threshold, components=args.components)
    low, high = mesh.bounds
    if output.suffix.lower() == ".glb":
        mesh.apply_transform(TO_Y_UP)
    with atomic_path(output) as temporary:
        mesh.export(temporary, file_type=output.suffix[1:].lower())
    print(
        f"wrote {output}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, from "
        f"{low.round(3).tolist()} to {high.round(3).tolist()}"
    )
