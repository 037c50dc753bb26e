"""Mesh files: OBJ, PLY, OFF and glTF."""
