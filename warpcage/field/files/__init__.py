"""Field files: the project's own, compact, svox2 and background layers."""
