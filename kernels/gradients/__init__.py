"""Kernels for gradients of frames of posed scenes, and of the maps that pose them."""
