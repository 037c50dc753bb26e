"""Films: the poses, cameras and edits that arguments name, a timeline of them, their frames, files and folders."""

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "edits": "Deformation EditReader PosedEdit read_edits_file write_edits_file",
        "film": "Film",
        "folder": "atomic_folder checked_film_path frame_files frame_path make_folder",
        "overlap": "BackgroundWriter SPARE stream",
        "motion": "cameras_along frame_places path_cameras pose_along pose_weights",
        "moves": "CameraMove MovingCamera camera_moves",
        "render": "Look",
        "timeline": "MovingScene Objects",
        "resolve": "AssetResolver RestCage",
        "video": "deep_pixels read_film_frame with_spread_colors write_film write_film_frame write_gif write_video",
    },
)
