"""Evaluations of items: fields compared with pictures of scenes."""

from __future__ import annotations

import json

from ..field.voxel_field import VoxelField
from ..fitting.cameras import tuned_scene
from ..fitting.evaluation import evaluation_report, in_world_of
from ..scene.load import load_scene
from .fields import LoadedFields
from .outputs import Made
from .references import References
from .scene_items import EvaluateItem


def make_evaluation(item: EvaluateItem, references: References, fields: LoadedFields) -> Made:
    """Compare a field with pictures of a scene, as `warpcage evaluate` does; what is made writes the report."""
    key, field = fields.get(item.field, item.scene_scale)
    if not isinstance(field, VoxelField):
        raise ValueError(f"evaluations are for fields of voxels (.npz), {item.field!r} is of splats")
    scene = load_scene(
        references.path(item.scene),
        split=item.split,
        downscale=item.downscale,
        format=item.format,
        background=field.background if item.background is None else item.background,
        masks=item.masks,
        cameras=None if item.cameras is None else references.path(item.cameras),
    )
    scene = in_world_of(field, scene)
    if item.tune_cameras:
        scene = tuned_scene(field, scene)
    found = evaluation_report(field, scene)
    fields.settle(key)
    content = {
        "field": item.field,
        "scene": item.scene,
        "split": item.split,
        "downscale": item.downscale,
        "tuned_cameras": item.tune_cameras,
        **found.to_json(),
    }
    text = json.dumps(content, indent=2) + "\n"
    return Made({item.outputs["report"]: lambda path: path.write_bytes(text.encode())})
