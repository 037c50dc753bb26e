"""Gradients of frames of posed scenes."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"frame": "frame_gradient", "loss": "FrameGradient"})
