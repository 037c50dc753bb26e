"""Cameras, frames, pictures, films and overlays."""
