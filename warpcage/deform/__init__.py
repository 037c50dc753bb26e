"""Deformed fields: the Deformer, edits and baking."""
