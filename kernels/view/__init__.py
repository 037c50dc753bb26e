"""Rays of cameras, pictures made smaller."""
