"""Sparse voxel grids: samples, rendering, refinement and background layers."""
