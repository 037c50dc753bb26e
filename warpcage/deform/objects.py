"""Objects of scenes, with cages or without, and their views by RenderOptions."""

from __future__ import annotations

from typing import Any, TypeAlias

from ..errors import InputError
from ..field.render import RenderOptions
from ..field.voxel_field import VoxelField
from ..render.surface_mesh import AnyObject
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import Frame
from .deformer import Deformer, PosedDeformer
from .fill import fill_unseen

#: What a stage holds.
SceneObject: TypeAlias = AnyObject | Deformer


def field_of(scene_object: SceneObject | PosedDeformer) -> Any:
    """The field or mesh of an object, without cages."""
    if isinstance(scene_object, PosedDeformer):
        scene_object = scene_object.deformer
    return scene_object.field if isinstance(scene_object, Deformer) else scene_object


def render_object(scene_object: SceneObject | PosedDeformer, camera: Camera, options: RenderOptions) -> Frame:
    """The view of a camera of an object; options that its kind does not have do nothing."""
    frame = scene_object._render(camera, options)
    if not options.fill or frame.reveal is None:
        return frame
    return fill_unseen(frame, require_voxels(field_of(scene_object), "fill"), camera)


def require_voxels(field: AnyObject, name: str) -> VoxelField:
    """A field of voxels. Raises ValueError for others; name: of the option, as the message begins."""
    if not isinstance(field, VoxelField):
        kind = "splats" if isinstance(field, SplatField) else "triangles"
        raise InputError(f"{name} is for fields of voxels (.npz), this one is of {kind}")
    return field
