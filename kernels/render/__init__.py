"""Kernels of frames: marches through deformed scenes, shading, and the views that launch them."""
