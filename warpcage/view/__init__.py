"""Cameras, frames, pictures, films and overlays."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "alignment": "Similarity aligning_similarity moved_along picture_shifts picture_similarity pose_errors",
        "camera": "camera_array camera_struct framing_orbit",
        "camera_path": "CameraMove MovingCamera camera_moves path_cameras timed_keys",
        "exr": "linear_light mean_picture read_exr write_exr write_picture",
        "film": "deep_pixels read_film_frame write_film write_film_frame write_gif write_video",
        "frame": "RGB_BYTES average_frame depth_along_view finer_camera",
        "frame_parts": "mask_picture mask_shares",
        "motion": (
            "axis_rotation cameras_along eased_share frame_places frame_rate frame_times limited_velocity pose_along "
            "pose_weights value_along value_at"
        ),
        "opacity": "rgba_picture with_spread_colors",
        "overlay": "draw_cage",
        "pictures": (
            "color_disparity contact_sheet disparity_range image_size read_image read_rows shrink "
            "side_by_side to_uint8 write_jpeg write_png"
        ),
    },
)
