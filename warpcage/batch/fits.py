"""Fits and evaluations of items."""

from __future__ import annotations

import json
import pathlib

import warp as wp

from ..core.memory import LRUCache
from ..field.voxel_field import VoxelField
from ..fitting.cameras import tuned_scene
from ..fitting.evaluation import evaluation_report, in_world_of
from ..fitting.fit import fit
from ..scene.load import load_scene
from ..scene.scene import Scene
from .fingerprints import Fingerprints
from .items import EvaluateItem, FitItem
from .manifest import MadeItem, Writer
from .references import LoadedFields, References


class FitMaker:
    """Fits fields, and keeps the pictures of the last scene: to read them takes as long as a short fit.
    fingerprints: of what items read, by which a changed scene is known."""

    def __init__(self, references: References, fingerprints: Fingerprints, device: wp.Device):
        self.references, self.fingerprints, self.device, self.read_count = references, fingerprints, device, 0
        self._scenes: LRUCache[Scene] = LRUCache(1)

    def forget(self) -> None:
        """Let go of the scene."""
        self._scenes.clear()

    def make(self, item: FitItem, checkpoint: pathlib.Path | None = None) -> MadeItem:
        """Fit a field to the pictures of a scene, as `warpcage fit` does; what is made writes its outputs.
        checkpoint: file (.npz) that holds the progress, from which a fit goes on whose worker died; None keeps none."""
        scene = self._scene(item)
        if checkpoint is not None:
            checkpoint.parent.mkdir(parents=True, exist_ok=True)
        field = fit(scene, device=self.device, progress=False, checkpoint=checkpoint, **item.options)
        writers: dict[str, Writer] = {item.outputs["field"]: field.save}
        refined = field.refined_cameras if isinstance(field, VoxelField) else None
        if refined is not None:
            writers[item.outputs["cameras"]] = refined.save
        return MadeItem(writers)

    def _scene(self, item: FitItem) -> Scene:
        words = item.split, item.downscale, item.format, item.background, item.masks, item.straighten
        key = item.scene, item.cameras, repr(words), self.fingerprints.of_inputs(item)

        def load() -> Scene:
            self.read_count += 1
            return load_scene(
                self.references.path(item.scene),
                split=item.split,
                downscale=item.downscale,
                format=item.format,
                background=item.background,
                masks=item.masks,
                orient="up" if item.straighten else None,
                cameras=None if item.cameras is None else self.references.path(item.cameras),
            )

        return self._scenes.get(key, load)


def make_evaluation(item: EvaluateItem, references: References, fields: LoadedFields) -> MadeItem:
    """Compare a field with pictures of a scene, as `warpcage evaluate` does; what is made writes the report."""
    key, field = fields.get(item.field, item.scene_scale)
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
        if not isinstance(field, VoxelField):
            raise ValueError(f"'tune_cameras' is for fields of voxels (.npz), {item.field!r} is of splats")
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
    return MadeItem({item.outputs["report"]: lambda path: path.write_bytes(text.encode())})
