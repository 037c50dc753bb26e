"""Scenes that the project makes, carried meshes and inverse maps: the truth that it is tested against."""
