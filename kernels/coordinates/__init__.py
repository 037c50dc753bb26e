"""Closed forms: mean value and green coordinates."""
