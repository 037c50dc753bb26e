"""`warpcage mesh`: extract the surface of a field."""

from __future__ import annotations

import argparse

import numpy as np

from ..core.files import atomic_path
from ..field.selection import NodeSelection
from ..mesh.io.gltf import write_glb
from . import inputs, options

#: Takes (x, y, z) to (x, z, -y): glTF has y up, while the other formats take coordinates as they are.
TO_Y_UP = ((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))

#: Formats that hold colours of vertices.
WITH_COLORS = (".glb", ".ply", ".obj")


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, options.MESH_ENDINGS, "mesh file")
    ending = output.suffix.lower()
    if args.colors and ending not in WITH_COLORS:
        raise ValueError(f"--colors: {ending} has no colours, {' '.join(WITH_COLORS)} have")
    field = inputs.require_voxels(inputs.read_field(args), "mesh")
    colored = ending == ".glb" if args.colors is None else args.colors

    selection = None if args.selection is None else NodeSelection.load(args.selection, field)
    mesh = field.extract_mesh(threshold=args.threshold, components=args.components, colors=colored, selection=selection)
    if args.as_captured and field.straightening is not None:
        mesh.apply_transform(np.linalg.inv(field.straightening))
    with atomic_path(output) as temporary:
        if ending == ".glb":
            colors = np.asarray(getattr(mesh.visual, "vertex_colors"))[:, :3] / 255.0 if colored else None  # noqa: B009
            upright = np.asarray(mesh.vertices) @ np.array(TO_Y_UP, np.float64)[:3, :3].T
            temporary.write_bytes(write_glb(upright, np.asarray(mesh.faces, np.int32), colors, name=output.stem))
        else:
            mesh.export(temporary, file_type=ending[1:])
    low, high = mesh.bounds
    print(
        f"wrote {output}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces{', with colours' * colored}, from "
        f"{low.round(3).tolist()} to {high.round(3).tolist()}"
    )
