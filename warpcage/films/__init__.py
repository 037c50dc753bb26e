"""Films: what words of poses and edits name, and folders of frames."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "edits": "Deformation EditReader Keyframes PosedEdit read_edits_file write_edits_file",
        "folder": "frame_files frame_path make_folder",
        "render": "Look",
        "words": "read_pose read_poses",
    },
)
