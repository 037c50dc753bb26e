"""Films of the command line: frames, their cameras, job files, folders and workers."""
