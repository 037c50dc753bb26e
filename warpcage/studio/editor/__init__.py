"""The editor: a page in the browser where a person poses cages and sees the scene follow."""
# A `document` never changes: each of `commands` makes a new one, and undo keeps the old. `session` holds the newest,
# saves it, calls listeners; `renderer` makes pictures; `server` and `clients` bring them to `page/`, modules unbuilt.

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "commands": "COMMANDS moved_keys moved_rest preset_pose replace_cage run_command slide",
        "demo": "demo_files",
        ".films.checks": "MAX_ID MAX_PLACE frozen_vertices parsed_json",
        ".films.document": "Document Key MAIN Selection Settings SceneObject Timeline View checked_view new_edit",
        "edit": "Editor",
        ".films.session.exports": (
            "Film export_baked export_cage export_command export_film export_poses film_pictures"
        ),
        "inspection": "Inspector inspect inspector",
        "renderer": (
            "COARSE_CELLS FRAME MIN_SIDE Pace Renderer Request band_camera depth_size frame_pixels joined_pixels "
            "packed_frame"
        ),
        ".films.session.scene": "Fields PosedScene read_fields same_pose view_camera",
        "server": "Server",
        "session": "Session new_document",
        ".films.session.session_file": "file_stamp free_session_path read_session session_path write_session",
        "steps.history": "DEPTH History read_history",
        "steps.losses": "losses",
        "objects": "field_files stage_of with_new_object with_stage",
        ".films.session.timeline": (
            "document_at frame_rate frame_times load_poses looped_time place_files placed_at pose_file state_at ways "
            "with_camera_moves with_pose_file"
        ),
        "work.jobs": "Cancelled Jobs MAX_JOBS MAX_UNFINISHED Outcome",
    },
)
