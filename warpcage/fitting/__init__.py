"""From posed pictures to a voxel field."""
