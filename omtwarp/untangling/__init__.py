"""Repair of flipped triangles."""
