"""Triangle meshes: reading, checking, repairing and generating them."""
