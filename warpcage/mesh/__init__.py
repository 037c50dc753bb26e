"""Closed triangle meshes: topology, faces, matching, containment, intersections."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "io": "read_mesh read_object write_shown_mesh",
        "io.formats": "MeshFormat mesh_formats",
        "io.gltf": "write_glb",
        "io.gltf_animation": "read_gltf_motion",
        "io.ply": "read_ply read_ply_points",
        "match": "require_same_faces",
        "mesh": "MeshTopology face_fans prepared_fans",
        "polygons": "cut_polygon",
        "queries": "intersecting_faces",
    },
)
