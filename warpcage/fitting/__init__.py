"""From posed pictures to a voxel field."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "batches": "PRECISIONS PictureRays TrainingPictures ViewCounts picture_bytes sum_shards",
        "cameras": "CameraRefinement CameraSums tuned_scene",
        "checkpoint": "NAMES load_progress save_progress scene_digest",
        "evaluation": "error_image ssim",
        "level": "Level Look gradient_parts node_bytes row_bytes",
        "memory": "memory_size scaled_shape",
        "options": "checked_options",
        "schedule": "MAX_SCARCE RAYS_PER_VOXEL plan_batches scarcity",
        "silhouettes": "Silhouettes keep_seen object_bounds",
        "surroundings": "chosen_background",
    },
)
