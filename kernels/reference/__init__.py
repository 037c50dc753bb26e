"""Ray casting and inverse maps: ground truth."""
