"""Cages: shapes, poses, checks, repair, refinement and generation."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "check": "check_pose grid_points",
        "generate": "surface_points",
        "generate.decimate": "EdgeCollapses progressive_hull",
        "generate.distance": "NearestInTree NearestInVoxels ObjectShell ObjectVoxels distance_to",
        "generate.fit": "HeldFaces face_samples",
        "generate.focus": "bending_of",
        "generate.mirror": "mirror_axes nearest_mirror",
        "generate.quads": "paired quad_weights",
        "generate.shell": "crossings",
        "generate.voxel": "outer_surface principal_frame",
        "pose_file": "are_numbered cache_poses cage_hash gltf_poses gltf_shown numbered_files sequence_poses",
        "poses": "direction move",
        "presets": "Preset is_preset",
        "random_poses": "POSE_MODES PosePath PoseProbe RandomNumbers",
        "snap": "cut_matter snap_to_gaps",
        "up_axis": "UpAxis restood standing_of_rest",
        "walls": "cut_faces",
    },
)
