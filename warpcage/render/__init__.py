"""Frames of edited scenes: views, tables, shading and launches."""
