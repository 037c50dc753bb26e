"""Pictures of a document: its scene as it is posed, and the thread that renders it."""
