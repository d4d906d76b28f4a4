"""The topology of triangle meshes: boundary loops, doubling, filling, cutting, and what kind of surface a mesh is."""
