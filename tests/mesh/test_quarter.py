"""Quartered meshes: counts, measures and origins, and maps extended without a flip."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces, is_bijective
from omtwarp.mesh import shapes
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.surface import Surface


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), faces=st.sampled_from([20, 60, 400]))
def test_parts_make_up_their_triangles(seed, faces):
    """Parts have a quarter of their triangle's area, its plane and orientation, and are as trimesh's subdivision."""
    surface = shapes.blob(seed, 0.3, 3, shapes.random_sphere(faces, seed))
    cut = quarter(surface)
    assert cut.surface.vertex_count == surface.vertex_count + len(surface.edges)
    assert cut.surface.face_count == 4 * surface.face_count
    np.testing.assert_allclose(cut.sum_of_parts(cut.surface.face_areas), surface.face_areas, rtol=1e-12)
    np.testing.assert_allclose(cut.surface.face_areas, surface.face_areas[cut.parents] / 4, rtol=1e-9)
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)[cut.parents]
    a, b, c = (cut.surface.vertices[cut.surface.faces[:, k]] for k in range(3))
    np.testing.assert_allclose(4 * np.cross(b - a, c - a), normals, atol=1e-12 * np.abs(normals).max())
    old = cut.vertex_origin >= 0
    np.testing.assert_array_equal(cut.surface.vertices[old], surface.vertices)
    np.testing.assert_allclose(cut.surface.vertices[~old], surface.vertices[cut.split_edges].mean(axis=1), atol=1e-15)
    other = trimesh.Trimesh(surface.vertices, surface.faces, process=False).subdivide()
    ours = trimesh.Trimesh(cut.surface.vertices, cut.surface.faces, process=False)
    assert ours.is_watertight and ours.euler_number == 2
    assert ours.volume == pytest.approx(other.volume, rel=1e-12)
    key = [np.sort(np.round(m.triangles_center, 9).view("f8,f8,f8").ravel()) for m in (ours, other)]
    np.testing.assert_array_equal(*key)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), squeeze=st.floats(0.0, 3.0))
def test_a_map_without_flips_stays_without_flips(seed, squeeze):
    """A map extended to midpoints, which are equally far from both ends, flips nothing, also if crowded to a pole."""
    surface = shapes.random_sphere(60, seed)
    sphere = surface.vertices * np.exp(squeeze * np.array([-1.0, -1.0, 1.0]))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    cut = quarter(surface)
    carried = cut.on_sphere(sphere)
    if not flipped_faces(sphere, surface.faces).any():
        assert not flipped_faces(carried, cut.surface.faces).any()
    assert is_bijective(carried, cut.surface.faces) == is_bijective(sphere, surface.faces)
    new = carried[surface.vertex_count :]
    np.testing.assert_allclose(np.linalg.norm(new, axis=1), 1.0, atol=1e-14)
    one, other = (sphere[cut.split_edges[:, k]] for k in range(2))
    np.testing.assert_allclose((new * one).sum(axis=1), (new * other).sum(axis=1), atol=1e-12)


def test_weights_and_what_cannot_be_cut():
    """Parts get a quarter of the weight; edges between opposite points and open meshes are refused."""
    ball = shapes.icosphere(2)
    weighted = ball.with_areas(np.linspace(1.0, 2.0, ball.face_count))
    cut = quarter(weighted)
    np.testing.assert_allclose(cut.surface.face_areas, weighted.face_areas[cut.parents] / 4, rtol=1e-12)
    sphere = ball.vertices.copy()
    i, j = ball.edges[0]
    sphere[j] = -sphere[i]
    assert np.isfinite(cut.on_sphere(sphere)).all()
    with pytest.raises(OmtwarpError, match="closed"):
        quarter(Surface(ball.vertices, ball.faces[1:]))
