"""Ground truth for tests and benchmarks: synthetic scenes, meshes that carry their colour, inverse maps."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "brick_scene": "write_brick_scene",
        "bricks": "box brick_model cylinder joined",
        "cage_scenes": "CAGE_SCENES scene_field",
        "casual": "CASUAL casual_scene casual_views",
        "inverse_map": "InverseMap",
        "models": "MODELS chair_model subdivided_model",
        "phone_video": "PhonePath TEXTURE table_scene write_phone_video",
        "raycast": "CarriedMesh render_mesh_views",
        "scenes": "FLOOR KINDS OBJECT_BOX ROOM_HALF object_model room_views synthetic_scene",
        "viewpoints": "reference_cameras spread_eyes",
    },
)
