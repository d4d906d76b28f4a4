"""Triangle meshes: reading, checking, mending and making them."""
