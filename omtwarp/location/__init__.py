"""Where on a triangulated sphere a point lies: the triangle that holds it, and its barycentric coordinates there."""

from __future__ import annotations

from omtwarp.location.locator import Found, Locator

__all__ = ["Found", "Locator"]
