"""Ray marching of deformed scenes, cage edits, and baking."""
