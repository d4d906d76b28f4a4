"""What fills a hole: closed, well shaped, of little area."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.validate import check
from omtwarp.topology.closing import fill_holes, fill_loop
from omtwarp.topology.kind import boundary_loops


def circle(count: int, wave: float = 0.0) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn), wave * np.cos(2.0 * turn)], axis=1)


def patch_mesh(points: np.ndarray) -> trimesh.Trimesh:
    vertices, faces = fill_loop(points)
    return trimesh.Trimesh(np.concatenate([points, vertices]), faces, process=False)


@pytest.mark.parametrize("count", [3, 4, 7, 8, 12, 50, 300])
def test_flat_loop_is_filled_flat_with_well_shaped_triangles(count):
    points = circle(count)
    mesh = patch_mesh(points)
    assert mesh.area == pytest.approx(0.5 * count * np.sin(2.0 * np.pi / count))
    assert np.degrees(mesh.face_angles).min() > 20.0
    (loop,) = boundary_loops(mesh.faces, len(mesh.vertices))
    assert loop.tolist() == [0, *range(count - 1, 0, -1)]  # against the loop, as the surface's neighbour


def test_area_is_that_of_the_minimal_surface():
    # Two coaxial circles joined by a slit would be a catenoid; over a wavy circle z = w cos 2t the minimal graph is
    # w r² cos 2t to first order, whose area is π (1 + w²) to second.
    wave = 0.1
    mesh = patch_mesh(circle(200, wave))
    polygon = 0.5 * 200 * np.sin(2.0 * np.pi / 200)
    assert mesh.area == pytest.approx(polygon * (1.0 + wave**2), rel=1e-3)


@given(st.integers(3, 40), st.integers(0, 1000), st.floats(1e-6, 1e6))
def test_any_loop_is_filled_whatever_its_size(count, seed, scale):
    rng = np.random.default_rng(seed)
    turn = np.sort(rng.random(count)) * 2.0 * np.pi
    points = scale * np.stack([np.cos(turn), np.sin(turn), rng.normal(size=count)], axis=1)
    mesh = patch_mesh(points)
    assert np.isfinite(mesh.vertices).all() and mesh.euler_number == 1
    assert len(boundary_loops(mesh.faces, len(mesh.vertices))) == 1
    assert np.abs(mesh.vertices).max() <= np.abs(points).max() * (1.0 + 1e-9)  # a vertex lies among its neighbours


def test_filled_surface_is_closed_and_marked():
    tube = trimesh.creation.cylinder(1.0, 3.0, sections=24)
    side = tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5]
    used, faces = np.unique(side, return_inverse=True)
    points, faces = np.asarray(tube.vertices[used]), faces.reshape(-1, 3)
    filled = fill_holes(points, faces, boundary_loops(faces, len(points)))
    assert not check(filled.vertices, filled.faces)
    assert np.array_equal(filled.faces[: len(faces)], faces) and np.array_equal(filled.vertices[: len(points)], points)
    assert (filled.patch[: len(faces)] == -1).all() and set(filled.patch[len(faces) :].tolist()) == {0, 1}
    assert trimesh.Trimesh(filled.vertices, filled.faces).volume == pytest.approx(tube.volume, rel=1e-6)


@pytest.mark.parametrize("points", [circle(30), circle(41, 0.3), np.random.default_rng(2).normal(size=(9, 3))])
def test_patch_is_the_same_whichever_vertex_comes_first(points):
    """Also of circles, where rounding alone says which vertex is farthest from the middle."""
    count, (vertices, faces) = len(points), fill_loop(points)
    for first in (1, count // 2, count - 1):
        others, turned = fill_loop(np.roll(points, -first, axis=0))
        own = np.where(turned < count, (turned + first) % count, turned)
        assert np.array_equal(others, vertices) and np.array_equal(own, faces)


@pytest.mark.parametrize("fill_area", ["natural", "small"])
def test_map_of_a_filled_surface_does_not_depend_on_numbers(fill_area):
    """The map of a surface with two holes is the same bits with other numbers of vertices, faces and corners."""
    blob = shapes.blob(seed=3, sphere=320)
    used, faces = np.unique(blob.faces[np.abs(blob.vertices[blob.faces, 2]).max(axis=1) < 0.6], return_inverse=True)
    vertices, faces = blob.vertices[used], faces.reshape(-1, 3)
    options = {"domain": "sphere", "fill_area": fill_area, "optimality": False, "device": "cpu"}
    result = omtwarp.map_surface((vertices, faces), **options)
    rng = np.random.default_rng(1)
    place = rng.permutation(len(vertices))
    moved = np.empty_like(vertices)
    moved[place] = vertices
    turned = [np.roll(corners, rng.integers(3)) for corners in place[faces][rng.permutation(len(faces))]]
    other = omtwarp.map_surface((moved, np.array(turned)), **options)
    assert np.array_equal(other.sphere[place], result.sphere) and len(result.loop_ends) == 2
