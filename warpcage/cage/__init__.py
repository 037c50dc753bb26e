"""Cages: shapes, poses, checks, repair, refinement and generation."""
