"""Frames of edited scenes: views, tables, shading and launches."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "launch": "FrameLauncher FrameTables FrameTarget load_pose_modules render_modules",
        "plan": "FrameFacts FramePlan PlannedEdit plan_frame",
        "shading": "CarriedColors",
        "tables": "CellBuffers FineCells",
        "tile_order": "BalancedTiles",
    },
)
