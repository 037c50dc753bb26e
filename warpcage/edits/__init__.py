"""Edits of a scene: an edit and its spec in files, its maps, falloff and fragments."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "apart": "EditBoxes box_gaps edit_boxes front_to_back",
        "falloff": "walls_share",
        "fragments": "fragment_voxels",
        "maps": "carried_points",
        "spec": "EditSpec",
    },
)
