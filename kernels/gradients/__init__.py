"""Kernels for gradients of frames of posed scenes."""
