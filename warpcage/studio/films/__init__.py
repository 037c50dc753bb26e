"""Films: what words of poses, cameras and edits name, a timeline of them, their frames, files and folders."""

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "edits": "Deformation EditReader Keyframes PosedEdit read_edits_file write_edits_file",
        "film": "Film",
        "folder": "atomic_folder checked_film_path frame_files frame_path make_folder",
        "render": "Look",
        "timeline": "MovingScene Objects Timeline",
        "resolve": "read_pose read_poses",
    },
)
