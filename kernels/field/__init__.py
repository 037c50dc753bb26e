"""Voxel grids: samples, rendering, refinement, background layers."""
