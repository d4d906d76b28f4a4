"""Closed surfaces of genus 0 that are hard to map: long triangles, sharp edges, thin sheets, spines, noise.

Every function returns a valid mesh, (vertices, faces), with the faces counter-clockwise seen from outside; the same
arguments give the same mesh.
"""

from __future__ import annotations

import numpy as np

from omtwarp.mesh import shapes


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


def stretched(surface, axes):
    """A mesh with its axes stretched, such as a plate 1:1000."""
    return surface.vertices * np.asarray(axes, dtype=float), surface.faces


def urchin(spines, length, frequency=8, seed=0):
    """A sphere with single vertices pulled out to so many times its radius."""
    sphere = shapes.icosphere(frequency)
    pulled = np.random.default_rng(seed).choice(sphere.vertex_count, spines, replace=False)
    radius = np.ones(sphere.vertex_count)
    radius[pulled] = length
    return sphere.vertices * radius[:, None], sphere.faces


def lognormal_sphere(spread, frequency=7, seed=0):
    """A sphere whose radii are independent log-normal numbers: noise at every vertex."""
    sphere = shapes.icosphere(frequency)
    radius = np.exp(spread * np.random.default_rng(seed).normal(size=sphere.vertex_count))
    return sphere.vertices * radius[:, None], sphere.faces


def flipped_edges(surface, rounds=6, seed=0):
    """A surface whose edges were flipped at random, so that triangles are of every shape."""
    flipped = shapes.flip_edges(surface, rounds=rounds, seed=seed)
    return flipped.vertices, flipped.faces


def large_face(share, frequency=8):
    """A sphere with a face that has this share of all the area: its corners are drawn out, its neighbours are long."""
    sphere = shapes.icosphere(frequency)
    vertices, faces = sphere.vertices.copy(), sphere.faces
    corners = faces[0]
    middle = vertices[corners].mean(axis=0)
    low, high = 1.0, 1e6
    for _ in range(100):
        factor = np.sqrt(low * high)
        moved = vertices.copy()
        moved[corners] = 3.0 * middle + factor * (vertices[corners] - middle)
        sides = np.cross(moved[faces[:, 1]] - moved[faces[:, 0]], moved[faces[:, 2]] - moved[faces[:, 0]])
        areas = np.linalg.norm(sides, axis=1)
        low, high = (factor, high) if areas[0] < share * areas.sum() else (low, factor)
    return moved, faces


def needle_pair(ratio, frequency=6):
    """A sphere with an edge split so close to its end that two triangles are needles of this length to their width."""
    sphere = shapes.icosphere(frequency)
    vertices, faces = sphere.vertices, [tuple(face) for face in sphere.faces.tolist()]
    a, b, _ = faces[0]
    new = len(vertices)
    point = vertices[a] + (vertices[b] - vertices[a]) / ratio
    out = []
    for face in faces:
        if a in face and b in face:
            out += [tuple(new if k == a else k for k in face), tuple(new if k == b else k for k in face)]
        else:
            out.append(face)
    return np.vstack([vertices, point]), np.array(out)


def random_mesh(seed):
    """One of the above with random numbers; returns what it is, and the mesh."""
    rng = np.random.default_rng(seed)
    kind = int(rng.integers(9))
    count = int(rng.integers(3, 60))
    if kind == 0:
        height = float(10.0 ** rng.uniform(-3, 1.5))
        cap = str(rng.choice(list(CAPS)))
        return f"prism({count}, {height:.3g}, {cap})", prism(count, height, cap)
    if kind == 1:
        axes = 10.0 ** rng.uniform(-3, 0, size=3)
        return f"ellipsoid {axes.round(4)}", stretched(shapes.icosphere(int(rng.integers(2, 8))), axes)
    if kind == 2:
        length = float(10.0 ** rng.uniform(0.1, 1.5))
        return f"urchin of {count // 3 + 1} spines to {length:.3g}", urchin(count // 3 + 1, length, 5, seed)
    if kind == 3:
        spread = float(rng.uniform(0.05, 1.0))
        return f"log-normal sphere {spread:.2f}", lognormal_sphere(spread, 5, seed)
    if kind == 4:
        rounds = int(rng.integers(1, 10))
        return f"sphere with {rounds} rounds of flips", flipped_edges(shapes.icosphere(5), rounds, seed)
    if kind == 5:
        length = float(rng.uniform(2.0, 20.0))
        return f"flipped tube of {length:.1f}", flipped_edges(shapes.tube(length, face_count=300), 3, seed)
    if kind == 6:
        share = float(rng.uniform(0.05, 0.6))
        return f"one face with {share:.2f} of the area", large_face(share, 4)
    if kind == 7:
        ratio = float(10.0 ** rng.uniform(1, 10))
        return f"needles of {ratio:.1e} to 1", needle_pair(ratio, 4)
    scale = float(10.0 ** rng.uniform(-150, 150))
    vertices, faces = lognormal_sphere(0.2, 4, seed)
    return f"scale {scale:.1e}", (scale * vertices, faces)
