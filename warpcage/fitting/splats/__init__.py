"""From posed pictures to Gaussian splats."""

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "from_voxels": "to_splats",
        "growth": "GrowingSplats",
        "loss": "PictureExposures PictureLoss",
        "optimizer": "SplatFit",
        "options": "SplatFitOptions checked_splat_options",
        "schedule": "SplatSchedule",
        "start": "Start fitted_scene scene_units starting_splats",
    },
)
