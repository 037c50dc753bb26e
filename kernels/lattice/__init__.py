"""Lattices over a cage: crossings, distances, nodes, solvers, narrow gaps and position maps."""
