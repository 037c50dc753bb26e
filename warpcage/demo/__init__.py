"""The embedded demo scene, other small scenes made from formulas, and the ray caster that renders their pictures."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "brick_scene": "write_brick_scene",
        "bricks": "box brick_model cylinder joined",
        "cage_scenes": "CAGE_SCENES scene_field",
        "raycast": "render_mesh_views",
        "viewpoints": "reference_cameras spread_eyes",
    },
)
