"""Readers of scene formats, one format a file."""
