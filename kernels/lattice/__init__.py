"""Crossings, distances, nodes, solvers and gaps on a lattice over a cage."""
