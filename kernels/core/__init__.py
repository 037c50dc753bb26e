"""Helpers that kernels share: lanes of a warp, entries of arrays."""
