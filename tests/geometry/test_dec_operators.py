"""Identities of the discrete exterior calculus on random closed meshes, and the kernels against the matrices."""

from __future__ import annotations

import numpy as np
import pytest
from dec_matrices import (
    circumcentres,
    divergence_matrix,
    dual_edge_lengths,
    face_normals,
    gradient_matrix,
    rotate,
    rotation_matrix,
)
from hypothesis import given, settings, strategies as st
from scipy import sparse
from scipy.spatial import ConvexHull

from omtwarp.errors import OmtwarpError
from omtwarp.geometry import DifferentialOperators, circumcentric_coordinates, corner_cotangents, cotangent_laplacian
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.surface import Surface


def random_closed_mesh(seed: int, count: int = 60, roughness: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """A sphere's Delaunay mesh of random points , stretched and roughened: many obtuse and thin triangles."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    faces = ConvexHull(points).simplices.astype(np.int32)
    inward = np.einsum("ij,ij->i", np.cross(*(points[faces[:, k]] for k in (0, 1))), points[faces[:, 2]]) < 0
    faces[inward] = faces[inward][:, ::-1]
    points = points * np.array([1.0, 2.0, 0.5]) * (1 + roughness * rng.normal(size=(count, 1)).clip(-2, 2))
    return points, faces


def test_meshes_under_test_have_obtuse_triangles():
    assert (corner_cotangents(*random_closed_mesh(0)) < 0).any(axis=1).mean() > 0.3


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_divergence_of_rotated_gradient_vanishes(seed):
    """Appendix B: div (J grad H) = 0 to round-off, relative to the terms that cancel."""
    vertices, faces = random_closed_mesh(seed)
    h = np.random.default_rng(seed + 1).normal(size=len(vertices))
    field = rotation_matrix(vertices, faces) @ (gradient_matrix(vertices, faces) @ h)
    divergence = divergence_matrix(vertices, faces)
    scale = abs(divergence) @ abs(field)
    np.testing.assert_array_less(abs(divergence @ field), 1e-14 * scale + 1e-300)
    operators = DifferentialOperators(vertices, faces, device="cpu")
    gradient = (gradient_matrix(vertices, faces) @ h).reshape(-1, 3)
    flux = operators.divergence(rotate(gradient, face_normals(vertices, faces)))
    np.testing.assert_array_less(abs(flux), 1e-14 * scale + 1e-300)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_gradient_is_exact_on_linear_functions(seed):
    vertices, faces = random_closed_mesh(seed)
    slope = np.random.default_rng(seed).normal(size=3)
    gradient = (gradient_matrix(vertices, faces) @ (vertices @ slope)).reshape(-1, 3)
    normals = face_normals(vertices, faces)
    expected = slope - (normals @ slope)[:, None] * normals
    tallest = (
        np.linalg.norm(vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=1) ** 2 / Surface(vertices, faces).face_areas
    )
    np.testing.assert_array_less(abs(gradient - expected).max(axis=1), 1e-12 * (1 + tallest))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_kernels_agree_with_matrices(seed):
    vertices, faces = random_closed_mesh(seed)
    rng = np.random.default_rng(seed)
    field = rng.normal(size=(len(faces), 3))
    operators = DifferentialOperators(vertices, faces, device="cpu")

    def check(got, matrix, operand):
        matrix = sparse.csr_matrix(matrix)
        scale = (abs(matrix) @ abs(operand.ravel())).reshape(got.shape)
        np.testing.assert_array_less(abs(got - (matrix @ operand.ravel()).reshape(got.shape)), 1e-12 * scale)

    check(operators.divergence(field), divergence_matrix(vertices, faces), field)
    normals = face_normals(vertices, faces)
    np.testing.assert_allclose(
        (rotation_matrix(vertices, faces) @ field.ravel()).reshape(-1, 3), rotate(field, normals), rtol=0, atol=1e-14
    )


def test_divergence_is_the_flux_through_the_circumcentric_dual():
    """The stable form of the matrix against appendix A.2 written out edge by edge with signed dual lengths."""
    vertices, faces = random_closed_mesh(3)
    rng = np.random.default_rng(0)
    field = rotate(rng.normal(size=(len(faces), 3)), face_normals(vertices, faces))
    lengths = dual_edge_lengths(vertices, faces)
    flux = np.zeros(len(vertices))
    for f, face in enumerate(faces):
        for k in range(3):
            tail, head, opposite = face[k], face[(k + 1) % 3], (k + 2) % 3
            edge = vertices[head] - vertices[tail]
            crossing = field[f] @ edge / np.linalg.norm(edge) * lengths[f, opposite]
            flux[tail] += crossing
            flux[head] -= crossing
    np.testing.assert_allclose(divergence_matrix(vertices, faces) @ field.ravel(), flux, rtol=0, atol=1e-9)
    areas = Surface(vertices, faces).vertex_areas
    np.testing.assert_allclose(
        divergence_matrix(vertices, faces, integrated=False, areas=areas) @ field.ravel(),
        flux / areas,
        rtol=1e-7,
        atol=1e-8,
    )


def test_laplacian_is_minus_divergence_of_gradient():
    vertices, faces = random_closed_mesh(5)
    matrix = cotangent_laplacian(vertices, faces)
    product = divergence_matrix(vertices, faces) @ gradient_matrix(vertices, faces)
    scale = abs(matrix).max()
    assert abs(matrix + product).max() < 1e-12 * scale
    assert abs(matrix - matrix.T).max() == 0
    assert abs(matrix @ np.ones(len(vertices))).max() < 1e-13 * scale
    assert np.linalg.eigvalsh(matrix.toarray()).min() > -1e-12 * scale


def test_right_triangle_by_hand():
    """Legs 3 and 4: the circumcentre is the middle of the hypotenuse, whose dual edge has length zero."""
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    faces = np.array([[0, 1, 2]])
    np.testing.assert_allclose(circumcentres(vertices, faces), [[1.5, 2, 0]], atol=1e-15)
    np.testing.assert_allclose(circumcentric_coordinates(vertices, faces), [[0, 0.5, 0.5]], atol=1e-15)
    np.testing.assert_allclose(dual_edge_lengths(vertices, faces), [[0, 1.5, 2]], atol=1e-15)
    gradient = gradient_matrix(vertices, faces) @ np.array([0.0, 3, 0])
    np.testing.assert_allclose(gradient, [1, 0, 0], atol=1e-15)


def test_circumcentres_are_equidistant():
    vertices, faces = random_closed_mesh(8)
    centres = circumcentres(vertices, faces)
    radii = np.stack([np.linalg.norm(vertices[faces[:, k]] - centres, axis=1) for k in range(3)], axis=1)
    np.testing.assert_allclose(radii / radii[:, :1], 1, rtol=0, atol=1e-8)


def test_dual_interpolation_is_exact_on_linear_functions_of_a_plane():
    """Two flat sheets sewn together, obtuse triangles included: interior vertices reproduce themselves."""
    rng = np.random.default_rng(2)
    ring = np.exp(2j * np.pi * np.sort(rng.uniform(size=7)))
    vertices = np.concatenate([[[0.1, -0.05, 0], [0.1, -0.05, 0]], np.c_[ring.real, ring.imag, np.zeros(7)]])
    around = np.arange(7)
    top = np.c_[np.zeros(7, int), 2 + around, 2 + (around + 1) % 7]
    bottom = np.c_[np.ones(7, int), 2 + (around + 1) % 7, 2 + around]
    faces = np.concatenate([top, bottom])
    assert (corner_cotangents(vertices, faces) < 0).any()
    operators = DifferentialOperators(vertices, faces, device="cpu")
    centres = circumcentres(vertices, faces)
    np.testing.assert_allclose(operators.interpolate_dual(centres)[:2], vertices[:2], atol=1e-13)
    np.testing.assert_allclose(operators.interpolate_dual(np.ones_like(centres)), 1, atol=1e-14)


def test_wrong_shapes_are_refused():
    ball = icosphere(2)
    operators = DifferentialOperators(ball.vertices, ball.faces, device="cpu")
    for function in (cotangent_laplacian, corner_cotangents, circumcentric_coordinates):
        with pytest.raises(OmtwarpError, match="faces: 41 in row"):
            function(ball.vertices[:-1], ball.faces)
    for field in ([], np.ones((79, 3)), np.ones((80, 2)), "abc", np.full((80, 3), np.nan)):
        for call in (operators.divergence, operators.interpolate_dual):
            with pytest.raises(OmtwarpError, match="field: "):
                call(field)
    with pytest.raises(OmtwarpError, match=r"vertices: shape"):
        cotangent_laplacian(np.zeros((4, 2)), np.zeros((4, 3), int))
