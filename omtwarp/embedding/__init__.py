"""Start maps that exist where the conformal map fails, and the mending of flipped triangles."""
