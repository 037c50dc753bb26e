"""Steps of a session: how they are undone and kept, and what they take from the keys of its film."""
