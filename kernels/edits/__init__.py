"""Kernels of edits: structs of a pose, maps of samples of a deformed scene to rest, tables of cells."""
