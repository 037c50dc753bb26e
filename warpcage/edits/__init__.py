"""Edits of a scene: one description of an edit, its maps, falloff and fragments."""
