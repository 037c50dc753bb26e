"""What the editor's server is made of: who may come in, files, and pages that are connected."""
