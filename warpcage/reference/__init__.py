"""Ground truth for tests and benchmarks: synthetic scenes, meshes that carry their colour, inverse maps."""
