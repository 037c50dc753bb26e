"""Posed pictures, and how they are loaded."""
