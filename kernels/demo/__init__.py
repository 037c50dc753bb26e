"""Ray casting of meshes and inverse maps: ground truth for tests and benchmarks."""
