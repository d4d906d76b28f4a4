"""Spherical barycentric maps: the system they solve, the shapes it is known on, and that nothing collapses."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from omtwarp.baselines import barycentric_map, barycentric_weights
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.metrics import measure_triangles


def _neighbour_means(surface: Surface, weights: str, sphere: np.ndarray) -> np.ndarray:
    """The normalised weighted mean of every vertex's neighbours, by a matrix product."""
    means = barycentric_weights(surface, weights) @ sphere
    return means / np.linalg.norm(means, axis=1)[:, None]


def _mean_values_by_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Floater's formula with arccos and tan, one corner at a time, made symmetric."""
    size = len(vertices)
    out = np.zeros((size, size))
    for face in faces:
        for k in range(3):
            i, j, l = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            u, v = vertices[j] - vertices[i], vertices[l] - vertices[i]
            angle = np.arccos(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)))
            out[i, j] += np.tan(angle / 2) / np.linalg.norm(u)
            out[i, l] += np.tan(angle / 2) / np.linalg.norm(v)
    return (out + out.T) / 2


def test_mean_value_weights_agree_with_the_formula():
    """The kernel's weights against Floater's formula written out."""
    surface = shapes.random_sphere(60, seed=3)
    expected = _mean_values_by_angles(surface.scaled_vertices, surface.faces)
    np.testing.assert_allclose(barycentric_weights(surface, "mean-value").toarray(), expected, rtol=1e-9)


def test_tutte_weights_are_the_adjacency():
    """Tutte's matrix has weight 1 on every edge and no other entry."""
    surface = shapes.random_sphere(60, seed=4)
    matrix = barycentric_weights(surface, "tutte").toarray()
    expected = np.zeros_like(matrix)
    expected[tuple(surface.edges.T)] = 1.0
    np.testing.assert_array_equal(matrix, expected + expected.T)


@pytest.mark.parametrize("weights", ["tutte", "mean-value"])
def test_an_icosahedron_is_its_own_map(weights):
    """By symmetry the regular icosahedron solves the system for both weights: distances between vertices are kept."""
    surface = shapes.icosphere(1)
    solution = barycentric_map(surface, weights=weights, balance="free", device="cpu")
    assert solution.residual < 1e-10
    unit = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    np.testing.assert_allclose(solution.sphere @ solution.sphere.T, unit @ unit.T, atol=1e-7)


@pytest.mark.parametrize("weights", ["tutte", "mean-value"])
def test_the_free_solution_solves_the_system_and_is_an_embedding(weights):
    """Every vertex is the normalised mean of its neighbours to round-off, and no triangle flips."""
    surface = shapes.blob(seed=2, sphere=1280)
    solution = barycentric_map(surface, weights=weights, balance="free", device="cpu")
    assert solution.converged
    means = _neighbour_means(surface, weights, solution.sphere)
    np.testing.assert_allclose(solution.sphere, means, atol=1e-10)
    judged = measure_triangles(surface.vertices, surface.faces, solution.sphere)
    assert judged.flips == 0 and judged.degree == pytest.approx(1.0, abs=1e-12)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), clustering=st.floats(0.0, 0.8), weights=st.sampled_from(["tutte", "mean-value"]))
def test_the_centred_map_does_not_collapse_or_flip(seed, clustering, weights):
    """On random triangulations: centroid at the origin, no flips, and what is left of the system is a_i λ."""
    surface = shapes.random_sphere(400, seed=seed, clustering=clustering)
    solution = barycentric_map(surface, weights=weights, device="cpu")
    masses = solution.shares
    np.testing.assert_allclose(masses @ solution.sphere, 0.0, atol=1e-10)
    judged = measure_triangles(surface.vertices, surface.faces, solution.sphere)
    assert judged.flips == 0 and judged.degree == pytest.approx(1.0, abs=1e-9)
    matrix = barycentric_weights(surface, weights)
    sums = matrix @ solution.sphere / (matrix.sum() / surface.vertex_count)
    rest = sums - masses[:, None] * solution.multiplier
    rest -= (rest * solution.sphere).sum(axis=1)[:, None] * solution.sphere
    assert np.abs(rest).max() < 1e-11 and solution.converged


def test_the_answer_does_not_depend_on_where_the_surface_is():
    """The map is the same for a scaled and moved surface, and the same bits at a second call."""
    surface = shapes.blob(seed=5, sphere=320)
    first = barycentric_map(surface, weights="mean-value", device="cpu").sphere
    np.testing.assert_array_equal(first, barycentric_map(surface, weights="mean-value", device="cpu").sphere)
    moved = Surface(1e4 * surface.vertices + 7.0, surface.faces)
    np.testing.assert_allclose(barycentric_map(moved, weights="mean-value", device="cpu").sphere, first, atol=1e-5)


def test_a_limb_keeps_its_embedding():
    """Long limbs crowd many vertices into little room: the map still covers the sphere once."""
    surface = shapes.limbs()
    for weights in ("tutte", "mean-value"):
        judged = measure_triangles(
            surface.vertices, surface.faces, barycentric_map(surface, weights=weights, device="cpu").sphere
        )
        assert judged.flips == 0 and judged.degree == pytest.approx(1.0, abs=1e-9)


def test_progress_and_errors():
    """Progress is called once per iteration with the residual; unknown options are refused in one line."""
    surface = shapes.icosphere(3)
    seen = []
    solution = barycentric_map(surface, device="cpu", progress=lambda *call: seen.append(call))
    assert [call[3]["residual"] for call in seen] == [record["residual"] for record in solution.history]
    assert len(solution.history) == solution.relaxation_steps + solution.newton_steps
    with pytest.raises(OmtwarpError, match="unknown weights"):
        barycentric_map(surface, weights="cotangent")
    with pytest.raises(OmtwarpError, match="unknown balance"):
        barycentric_map(surface, balance="area")
    flat = surface.vertices.copy()
    flat[surface.faces[0]] = flat[surface.faces[0, 0]]
    with pytest.raises(OmtwarpError, match="triangles with area"):
        barycentric_weights(Surface(flat, surface.faces), "mean-value")
