"""The film of a session of the editor: its scene at a time, the frames, and other files that are made of it."""
