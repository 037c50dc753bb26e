"""Triangles, fans of faces, and containment in closed meshes."""
