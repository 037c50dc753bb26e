"""Closed triangle meshes: topology, faces, matching, containment, intersections."""
