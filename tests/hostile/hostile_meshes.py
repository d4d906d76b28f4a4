"""Closed surfaces of genus 0 that are hard to map: long triangles, sharp edges, thin sheets, spines, noise.

Every function returns a valid mesh, (vertices, faces), with the faces counter-clockwise seen from outside; the same
arguments give the same mesh.
"""

from __future__ import annotations

import numpy as np

from omtwarp.mesh import shapes


def strip_cap(count):
    """Triangulate a polygon as one zigzag strip, counter-clockwise: all triangles but two are long."""
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
    """Triangulate a polygon as a fan around its first corner, counter-clockwise."""
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


def bipyramid(count):
    """Two tips over a polygon of so many corners: fans of long triangles."""
    turn = 2.0 * np.pi * np.arange(count) / count
    points = np.vstack([np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn]), [[0, 0, 1], [0, 0, -1]]])
    here = np.arange(count)
    following = (here + 1) % count
    above = np.stack([here, following, np.full(count, count)], axis=1)
    below = np.stack([following, here, np.full(count, count + 1)], axis=1)
    return points, np.concatenate([above, below]).astype(np.int32)


def zigzag_between(outer, inner):
    """Fill the ring between two convex polygons of one plane, one inside the other, counter-clockwise.

    Triangles stand on one side of either polygon, in the order of the sides' directions, and on the corner of the
    other polygon that lies farthest across that side.
    """
    out, into = len(outer), len(inner)
    sides = [np.roll(points, -1, axis=0) - points for points in (outer, inner)]
    turns = [np.arctan2(side[:, 1], side[:, 0]) for side in sides]
    steps = sorted(
        [(turn, 0, k) for k, turn in enumerate(turns[0])] + [(turn, 1, k) for k, turn in enumerate(turns[1])]
    )
    # The corners that the first side by direction finds: where each polygon's side of the least direction begins.
    at = [int(np.argmin(turn)) for turn in turns]
    triangles = []
    for _, which, k in steps:
        at[which] = k
        following = (k + 1) % (into if which else out)
        if which == 0:
            triangles.append((k, following, out + at[1]))
        else:
            triangles.append((out + following, out + k, at[0]))
        at[which] = following
    return np.array(triangles)


def boxes_joined(sides, place, radius, height, cap="strip", seed=0):
    """A box with a prism that stands on its lid or is sunk into it, triangulated without a vertex inside a face.

    Args:
        sides: corners of the prism, turned at random.
        place: of the prism's axis on the lid, in the square from -1 to 1; the prism has to keep inside it.
        radius: of the prism.
        height: of the prism; above -1, and a pocket where it is negative.
        cap: of CAPS, how its far end is triangulated.
        seed: of the turn.
    """
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    turn = 2.0 * np.pi * (np.arange(sides) + np.random.default_rng(seed).random()) / sides
    ring = np.asarray(place) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    levels = [(square, -1.0), (square, 0.0), (ring, 0.0), (ring, height)]
    vertices = np.concatenate([np.column_stack([points, np.full(len(points), z)]) for points, z in levels])

    def wall(low, high, count):
        i = np.arange(count)
        j = (i + 1) % count
        return np.concatenate(
            [np.stack([low + i, low + j, high + j], axis=1), np.stack([low + i, high + j, high + i], axis=1)]
        )

    bottom, end = CAPS["fan"](4)[:, ::-1], 8 + sides + CAPS[cap](sides)
    lid = 4 + zigzag_between(square, ring)
    return vertices, np.concatenate([bottom, wall(0, 4, 4), lid, wall(8, 8 + sides, sides), end])


def collapsed(surface, face_count, seed=0, choices=4):
    """A surface decimated crudely: edges are drawn into one of their ends, the shortest of a few at random each time.

    No fold is avoided and no sliver; the mesh stays closed and manifold (the ends of an edge have two common
    neighbours).
    """
    rng = np.random.default_rng(seed)
    faces = {k: tuple(face) for k, face in enumerate(surface.faces.tolist())}
    at = [set() for _ in range(surface.vertex_count)]
    for k, face in faces.items():
        for vertex in face:
            at[vertex].add(k)
    points = surface.vertices
    for _ in range(50 * surface.face_count):
        if len(faces) <= face_count:
            break
        numbers = list(faces)
        edges = []
        for k in rng.integers(len(numbers), size=choices):
            corner = int(rng.integers(3))
            face = faces[numbers[k]]
            edges.append((face[corner], face[corner - 1]))
        a, b = min(edges, key=lambda edge: np.linalg.norm(points[edge[0]] - points[edge[1]]))
        around = [{vertex for k in at[end] for vertex in faces[k]} - {a, b} for end in (a, b)]
        if len(around[0] & around[1]) != 2 or len(around[0] | around[1]) < 4:
            continue
        for k in list(at[b]):
            face = faces.pop(k)
            for vertex in face:
                at[vertex].discard(k)
            if a not in face:
                faces[k] = tuple(a if vertex == b else vertex for vertex in face)
                for vertex in faces[k]:
                    at[vertex].add(k)
    left = np.array(list(faces.values()))
    used, renumbered = np.unique(left, return_inverse=True)
    return points[used], renumbered.reshape(-1, 3)


def creature(seed, face_count, limb_count=4):
    """A body with limbs in random directions, decimated crudely."""
    rng = np.random.default_rng(seed)
    ends = rng.normal(size=(limb_count, 3))
    ends *= rng.uniform(1.0, 2.2, size=(limb_count, 1)) / np.linalg.norm(ends, axis=1, keepdims=True)
    limbs = [(0.0, 0.0, 0.0, 0.6, *end, 0.3) for end in ends]
    body = shapes.implicit_surface(shapes.metaballs(limbs, 0.05), [-2.8] * 3, [2.8] * 3, 0.25)
    return collapsed(body, face_count, seed)


def random_mesh(seed, most_faces=1500):
    """Make one of the meshes above with random parameters; return its name and the mesh."""
    rng = np.random.default_rng(seed)
    kind = int(rng.integers(12))
    largest = int(np.sqrt(most_faces / 20))  # frequency of an icosphere
    frequency = int(rng.integers(2, largest + 1))
    count = int(rng.integers(3, most_faces // 5))  # of sides: a prism has four times as many faces
    spines = int(rng.integers(1, 20))
    if kind == 0:
        height = float(10.0 ** rng.uniform(-3, 1.5))
        cap = str(rng.choice(list(CAPS)))
        return f"prism({count}, {height:.3g}, {cap})", prism(count, height, cap)
    if kind == 1:
        axes = 10.0 ** rng.uniform(-3, 0, size=3)
        return f"ellipsoid {axes.round(4)}", stretched(shapes.icosphere(frequency), axes)
    if kind == 2:
        length = float(10.0 ** rng.uniform(0.1, 1.5))
        return f"urchin of {spines} spines to {length:.3g}", urchin(spines, length, largest, seed)
    if kind == 3:
        spread = float(rng.uniform(0.05, 1.0))
        return f"log-normal sphere {spread:.2f}", lognormal_sphere(spread, frequency, seed)
    if kind == 4:
        rounds = int(rng.integers(1, 10))
        return f"sphere with {rounds} rounds of flips", flipped_edges(shapes.icosphere(largest), rounds, seed)
    if kind == 5:
        length = float(rng.uniform(2.0, 20.0))
        tube = shapes.tube(length, face_count=int(rng.integers(most_faces // 3, most_faces)))
        return f"flipped tube of {length:.1f}", flipped_edges(tube, 3, seed)
    if kind == 6:
        share = float(rng.uniform(0.05, 0.6))
        return f"one face with {share:.2f} of the area", large_face(share, frequency)
    if kind == 7:
        ratio = float(10.0 ** rng.uniform(1, 10))
        return f"needles of {ratio:.1e} to 1", needle_pair(ratio, frequency)
    if kind == 8:
        scale = float(10.0 ** rng.uniform(-150, 150))
        vertices, faces = lognormal_sphere(0.2, frequency, seed)
        return f"scale {scale:.1e}", (scale * vertices, faces)
    if kind == 9:
        radius = float(10.0 ** rng.uniform(-3, -0.3))
        gap = float(10.0 ** rng.uniform(-5, -0.5))  # to the lid's side
        place = (1.0 - gap) * (1.0 - radius) * rng.choice([-1.0, 1.0], size=2) * np.array([1.0, rng.random()])
        height = float(-0.99 * rng.random() if rng.random() < 0.5 else 10.0 ** rng.uniform(-2, 1))
        cap = str(rng.choice(list(CAPS)))
        name = f"box with a prism of {count} sides, radius {radius:.3g}, height {height:.3g}, gap {gap:.1e}"
        return name, boxes_joined(count, place, radius, height, cap, seed)
    if kind == 10:
        thickness = float(10.0 ** rng.uniform(-3, -1))
        grid = shapes.plate(1.0, float(rng.uniform(0.2, 1.0)), thickness, face_count=20 * frequency**2)
        return f"plate 1:{1 / thickness:.0f}", (grid.vertices, grid.faces)
    faces = int(rng.integers(40, most_faces))
    limb_count = int(rng.integers(2, 6))
    return f"creature with {limb_count} limbs cut down to {faces} faces", creature(seed, faces, limb_count)
