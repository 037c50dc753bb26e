"""Coordinates of points in a cage, and points moved by them."""
