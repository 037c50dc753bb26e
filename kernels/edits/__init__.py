"""Kernels of edits: what a pose is, where samples of a deformed scene lie at rest, tables of cells."""
