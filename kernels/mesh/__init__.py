"""Triangles, fans of faces, containment."""
