"""Cages made around an object."""
