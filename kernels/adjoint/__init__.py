"""Adjoints of maps and of closed forms: slopes of a number by cages, from those by positions."""
