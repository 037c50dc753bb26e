"""Ground truth for tests and benchmarks: synthetic scenes, meshes that carry their colour, inverse maps."""

from .carried_mesh import CarriedMesh
from .casual import CASUAL, casual_scene, casual_views
from .inverse_map import InverseMap
from .models import MODELS, chair_model, subdivided_model
from .phone_video import TEXTURE, PhonePath, phone_cameras, table_scene, take_picture, write_phone_video
from .scenes import FLOOR, KINDS, OBJECT_BOX, ROOM_HALF, object_model, room_views, synthetic_scene

__all__ = [
    "CASUAL",
    "FLOOR",
    "KINDS",
    "MODELS",
    "OBJECT_BOX",
    "ROOM_HALF",
    "TEXTURE",
    "CarriedMesh",
    "InverseMap",
    "PhonePath",
    "casual_scene",
    "casual_views",
    "chair_model",
    "object_model",
    "phone_cameras",
    "room_views",
    "subdivided_model",
    "synthetic_scene",
    "table_scene",
    "take_picture",
    "write_phone_video",
]
