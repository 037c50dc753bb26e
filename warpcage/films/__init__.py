"""Films: what words of poses and edits name, and folders of frames."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "folder": "frame_files frame_path make_folder",
        "words": "Keyframes read_edits_file read_pose read_poses write_edits_file",
    },
)
