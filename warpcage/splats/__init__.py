"""Gaussian splats: fields of them, their files, their views, and how a cage poses them."""
