"""Voxel radiance fields: what they hold, how they render, what lies behind them."""
