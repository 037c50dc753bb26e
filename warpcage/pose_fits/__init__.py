"""Poses of cages from pictures, depth and points: the other way round."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__, {"fit": "PoseFit PoseStep fit_pose fit_poses", "targets": "PoseTargets"}
)
