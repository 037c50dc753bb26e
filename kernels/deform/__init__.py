"""Deformed marches, edits and baking."""
