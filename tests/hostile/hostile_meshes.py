"""Closed surfaces of genus 0 that are hard to map: long triangles, sharp edges, thin sheets, spines, noise.

Every function returns a valid mesh, (vertices, faces), with the faces counter-clockwise seen from outside; the same
arguments give the same mesh.
"""

from __future__ import annotations

import numpy as np


def strip_cap(count):
    """A polygon of so many corners as one zigzag strip of triangles, counter-clockwise: all but two are long."""
    low, high = 0, count - 1
    triangles = []
    while high - low > 1:
        if len(triangles) % 2 == 0:
            triangles.append((low, low + 1, high))
            low += 1
        else:
            triangles.append((low, high - 1, high))
            high -= 1
    return np.array(triangles)


def fan_cap(count):
    """A polygon as a fan around its first corner, counter-clockwise."""
    k = np.arange(1, count - 1)
    return np.stack([np.zeros_like(k), k, k + 1], axis=1)


CAPS = {"strip": strip_cap, "fan": fan_cap}


def prism(count, height, cap="strip"):
    """A prism over a regular polygon of radius 1, its two faces triangulated without a vertex inside."""
    turn = 2.0 * np.pi * np.arange(count) / count
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    top, bottom = (np.column_stack([circle, np.full(count, sign * height / 2.0)]) for sign in (1, -1))
    i = np.arange(count)
    j = (i + 1) % count
    sides = [np.stack([i, count + i, count + j], axis=1), np.stack([i, count + j, j], axis=1)]
    lid = CAPS[cap](count)
    return np.concatenate([top, bottom]), np.concatenate([*sides, lid, count + lid[:, ::-1]])
