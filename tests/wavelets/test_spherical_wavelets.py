"""The hierarchy, the lifted transforms and the sampling operators, against their defining identities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import sparse

from omtwarp.device import threads
from omtwarp.device.start import wp
from omtwarp.device.threads import GraphsByArray, step_by_step
from omtwarp.errors import OmtwarpError
from omtwarp.geometry import cotangent_laplacian
from omtwarp.wavelets import SphereSampler, SphericalWavelets, WaveletPreconditioner, level_for, sphere_hierarchy
from omtwarp.wavelets.transform import WaveletFilter

LEVEL = 3


def node_levels(hierarchy) -> np.ndarray:
    """Level of the wavelet that belongs to each node; -1 for the nodes of the icosahedron, which have none."""
    return np.searchsorted(hierarchy.node_counts, np.arange(hierarchy.node_count), side="right") - 1


def smooth_function(x: np.ndarray) -> np.ndarray:
    return np.exp(x[:, 0]) * np.cos(2 * x[:, 1] + 0.3) + x[:, 2] ** 3


def sphere_points(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def test_hierarchy_is_nested_closed_and_outward():
    hierarchy = sphere_hierarchy(LEVEL)
    assert hierarchy.vertices.shape == (hierarchy.node_count, 3)
    np.testing.assert_allclose(np.linalg.norm(hierarchy.vertices, axis=1), 1, atol=1e-15)
    for j, faces in enumerate(hierarchy.level_faces):
        nodes = hierarchy.vertices[: hierarchy.node_counts[j]]
        assert hierarchy.node_counts[j] - 3 * len(faces) // 2 + len(faces) == 2
        assert faces.max() == hierarchy.node_counts[j] - 1
        assert (np.linalg.det(nodes[faces]) > 0).all()
        if j > 0:
            parent = hierarchy.level_faces[j - 1]
            for corner in range(3):
                np.testing.assert_array_equal(faces[corner::4, corner], parent[:, corner])
            ends = hierarchy.vertices[hierarchy.level_parents[j - 1]]
            middle = ends.sum(axis=1) / np.linalg.norm(ends.sum(axis=1), axis=1)[:, None]
            np.testing.assert_allclose(nodes[hierarchy.node_counts[j - 1] :], middle, atol=1e-15)
    assert hierarchy.node_areas.sum() == pytest.approx(4 * np.pi, rel=1e-13)


def test_hierarchy_reaches_level_eight():
    assert sphere_hierarchy(8).node_count == 10 * 4**8 + 2


def test_butterfly_wings_on_a_regular_neighbourhood():
    """The eight nodes are distinct away from the solid, and the four outer ones touch exactly one wing and one end."""
    hierarchy = sphere_hierarchy(3)
    faces = hierarchy.level_faces[2]
    keys = {tuple(sorted(face)) for face in faces.tolist()}
    for (a, b), (c, d, *outer) in zip(
        hierarchy.level_parents[2].tolist(), hierarchy.level_wings[2].tolist(), strict=True
    ):
        assert tuple(sorted((a, b, c))) in keys and tuple(sorted((a, b, d))) in keys
        assert len({a, b, c, d, *outer}) == 8
        for node in outer:
            assert sum(tuple(sorted((node, e, w))) in keys for e in (a, b) for w in (c, d)) == 1


@pytest.mark.parametrize("butterfly", [False, True])
def test_perfect_reconstruction(butterfly):
    hierarchy = sphere_hierarchy(LEVEL)
    wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device="cpu")
    values = np.random.default_rng(1).normal(size=hierarchy.node_count)
    np.testing.assert_allclose(wavelets.inverse(wavelets.forward(values)), values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(wavelets.forward(wavelets.inverse(values)), values, rtol=0, atol=1e-12)


def synthesis_matrix(wavelets: SphericalWavelets) -> np.ndarray:
    return np.stack([wavelets.wavelet(i) for i in range(wavelets.hierarchy.node_count)], axis=1)


@pytest.mark.parametrize("butterfly", [False, True])
def test_wavelets_have_vanishing_integral_and_local_support(butterfly):
    hierarchy = sphere_hierarchy(3)
    wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device="cpu")
    synthesis = synthesis_matrix(wavelets)
    integrals = hierarchy.node_areas @ synthesis
    assert abs(integrals[hierarchy.node_counts[0] :]).max() < 1e-12
    assert integrals[: hierarchy.node_counts[0]].sum() == pytest.approx(4 * np.pi, rel=1e-12)
    support = (synthesis != 0).sum(axis=0)
    assert support[node_levels(hierarchy) == 2].max() < 0.1 * hierarchy.node_count


@pytest.mark.parametrize("butterfly", [False, True])
def test_primal_and_dual_are_biorthogonal(butterfly):
    """Dual functions are the rows of the analysis: <psi~, psi> = identity, and the adjoints are transposes of both."""
    hierarchy = sphere_hierarchy(2)
    wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device="cpu")
    identity = np.eye(hierarchy.node_count)
    synthesis = synthesis_matrix(wavelets)
    duals = np.stack([wavelets._on_copy(row, wavelets.analyse_adjoint) for row in identity])
    np.testing.assert_allclose(duals @ synthesis, identity, rtol=0, atol=1e-12)
    transposed = np.stack([wavelets._on_copy(row, wavelets.synthesise_adjoint) for row in identity], axis=1)
    np.testing.assert_allclose(transposed, synthesis.T, rtol=0, atol=1e-13)


@pytest.mark.parametrize("butterfly", [False, True])
def test_hat_wavelet_is_the_formula_of_section_3_1(butterfly):
    hierarchy = sphere_hierarchy(3)
    wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device="cpu")
    for level, m in ((0, 3), (1, 17), (2, 100)):
        node = hierarchy.node_counts[level] + m
        expected = wavelets.scaling_function(level + 1, node)
        for k in hierarchy.level_parents[level][m]:
            share = wavelets.level_integrals[level + 1][node] / (2 * wavelets.level_integrals[level][k])
            expected = expected - share * wavelets.scaling_function(level, k)
        np.testing.assert_allclose(wavelets.wavelet(node), expected, rtol=0, atol=1e-14)
    for level, k in ((1, 5), (2, 80)):
        integral = hierarchy.node_areas @ wavelets.scaling_function(level, k)
        assert integral == pytest.approx(wavelets.level_integrals[level][k], rel=1e-12)


@pytest.mark.parametrize("butterfly", [False, True])
def test_constants_have_no_wavelet_coefficients(butterfly):
    hierarchy = sphere_hierarchy(LEVEL)
    wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device="cpu")
    coefficients = wavelets.forward(np.full(hierarchy.node_count, 3.0))
    np.testing.assert_array_equal(coefficients[hierarchy.node_counts[0] :], 0)
    np.testing.assert_array_equal(coefficients[: hierarchy.node_counts[0]], 3.0)
    np.testing.assert_array_equal(wavelets.inverse(coefficients), 3.0)


def test_coefficients_of_a_smooth_function_fall_by_four_per_level():
    """Second order for both: the nodes are not evenly spaced, so the butterfly gains a factor and not an order."""
    hierarchy = sphere_hierarchy(6)
    values = smooth_function(hierarchy.vertices)
    sizes = []
    for butterfly in (False, True):
        coefficients = SphericalWavelets(hierarchy, butterfly=butterfly, device="cpu").forward(values)
        size = np.array([abs(coefficients[node_levels(hierarchy) == j]).mean() for j in range(6)])
        ratios = size[2:-1] / size[3:]
        assert (ratios > (3 if butterfly else 3.8)).all() and (ratios < 4.2).all(), ratios
        sizes.append(size)
    assert sizes[1][-1] < 0.5 * sizes[0][-1], sizes


def test_lifting_keeps_the_mean_of_a_truncated_function():
    """With zero integrals, clearing wavelets leaves the integral alone; without lifting it does not."""
    from omtwarp.device.start import wp

    hierarchy = sphere_hierarchy(4)
    values = smooth_function(hierarchy.vertices) + np.random.default_rng(0).normal(size=hierarchy.node_count)
    means = []
    for lifted in (True, False):
        wavelets = SphericalWavelets(hierarchy, lifted=lifted, device="cpu")
        array = wp.array(values, device="cpu")
        wavelets.analyse(array)
        wavelets.truncate(array, 1)
        assert not array.numpy()[hierarchy.node_counts[2] :].any()
        wavelets.synthesise(array)
        means.append(hierarchy.node_areas @ array.numpy())
    assert means[0] == pytest.approx(hierarchy.node_areas @ values, abs=1e-11)
    assert abs(means[1] - hierarchy.node_areas @ values) > 1e-3


@pytest.mark.parametrize("butterfly", [False, True])
def test_preconditioner_is_symmetric_positive_and_nearly_level_independent(butterfly):
    """The spectrum of S D S^T L off the constants: its spread bounds the steps a descent needs, and barely grows."""
    conditions = []
    for level in (1, 2, 3):
        hierarchy = sphere_hierarchy(level)
        preconditioner = WaveletPreconditioner(hierarchy, butterfly=butterfly, device="cpu")
        laplacian = cotangent_laplacian(hierarchy.vertices, hierarchy.faces).toarray()
        inverse = np.stack([preconditioner.apply(e) for e in np.eye(hierarchy.node_count)], axis=1)
        np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-14)
        root = np.linalg.cholesky(inverse + 1.0)  # any multiple of the constants may be added: the Laplacian ignores it
        eigenvalues = np.linalg.eigvalsh(root.T @ laplacian @ root)
        assert abs(eigenvalues[0]) < 1e-12
        conditions.append(eigenvalues[-1] / eigenvalues[1])
    assert conditions[-1] < 10 and conditions[2] < 1.5 * conditions[1], conditions


def interpolation_matrix(sampler: SphereSampler) -> sparse.csr_matrix:
    """Linear interpolation from nodes to points, of the triangles and coordinates that the sampler has found."""
    faces = sampler.hierarchy.level_faces[sampler.level][sampler.point_faces.numpy()]
    offsets = np.arange(0, 3 * sampler.point_count + 1, 3)
    shape = (sampler.point_count, sampler.node_count)
    return sparse.csr_matrix((sampler.coordinates.numpy().ravel(), faces.ravel(), offsets), shape)


def gradients_at(sampler: SphereSampler, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Gradients of the nodes, linear between them, in the tangent plane at every point."""
    between = interpolation_matrix(sampler) @ sampler.node_gradient(values).numpy()
    return between - np.einsum("ij,ij->i", between, points)[:, None] * points


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), level=st.integers(0, 5))
def test_points_are_found_and_reproduced(seed, level):
    """The ray through a point meets its triangle at its coordinates: nodes, edge middles and random points alike."""
    hierarchy = sphere_hierarchy(5)
    rng = np.random.default_rng(seed)
    corners = hierarchy.vertices[hierarchy.level_faces[level][rng.integers(len(hierarchy.level_faces[level]), size=20)]]
    middles = corners[:, 0] + corners[:, 1]
    points = np.concatenate(
        [sphere_points(50, seed), corners[:, 0], middles / np.linalg.norm(middles, axis=1)[:, None]]
    )
    sampler = SphereSampler(hierarchy, points, level=level, device="cpu")
    on_plane = interpolation_matrix(sampler) @ hierarchy.vertices[: sampler.node_count]
    np.testing.assert_allclose(on_plane / np.linalg.norm(on_plane, axis=1)[:, None], points, rtol=0, atol=5e-15)
    assert sampler.coordinates.numpy().min() >= 0
    np.testing.assert_allclose(sampler.coordinates.numpy().sum(axis=1), 1, rtol=0, atol=1e-15)


def test_interpolation_and_its_adjoint():
    hierarchy = sphere_hierarchy(LEVEL)
    sampler = SphereSampler(hierarchy, sphere_points(3000), device="cpu")
    rng = np.random.default_rng(1)
    values, weights = rng.normal(size=hierarchy.node_count), rng.normal(size=3000)
    matrix = interpolation_matrix(sampler)
    np.testing.assert_allclose(sampler.interpolate(values), matrix @ values, rtol=0, atol=1e-14)
    np.testing.assert_allclose(sampler.adjoint(weights), matrix.T @ weights, rtol=0, atol=1e-13)
    np.testing.assert_allclose(sampler.interpolate(np.full(hierarchy.node_count, 2.0)), 2.0, rtol=0, atol=1e-15)


def test_gradients_between_the_nodes_and_their_adjoint():
    errors = []
    for level in (3, 4):
        hierarchy = sphere_hierarchy(level)
        points = sphere_points(2000, 5)
        sampler = SphereSampler(hierarchy, points, device="cpu")
        x = hierarchy.vertices
        gradient = gradients_at(sampler, x[:, 0] * x[:, 1] + x[:, 2], points)
        exact = np.stack([points[:, 1], points[:, 0], np.ones(len(points))], axis=1)
        exact -= np.einsum("ij,ij->i", exact, points)[:, None] * points
        errors.append(abs(gradient - exact).mean())
        rng = np.random.default_rng(2)
        values, field = rng.normal(size=hierarchy.node_count), rng.normal(size=(len(points), 3))
        left = (field * gradients_at(sampler, values, points)).sum()
        adjoint = sampler.gradient_adjoint(field)
        assert left == pytest.approx(values @ adjoint, rel=1e-10)
        assert abs(adjoint.sum()) < 1e-9
    order = np.log2(errors[0] / errors[1])
    assert order > 1.6, errors


def test_restriction_is_a_mean_defined_everywhere():
    """More nodes than points: constants stay exact, a function comes back, and no node is left without a value."""
    hierarchy = sphere_hierarchy(5)
    points = sphere_points(1500, 3)
    points = points[points[:, 2] < 0.8]
    sampler = SphereSampler(hierarchy, points, device="cpu")
    masses = np.random.default_rng(0).uniform(0.5, 1.5, size=len(points))
    with pytest.raises(OmtwarpError, match="set_masses"):
        sampler.restrict(masses)
    sampler.set_masses(masses)
    np.testing.assert_allclose(sampler.restrict(2.5 * masses), 2.5, rtol=0, atol=1e-13)
    values = smooth_function(points)
    restricted = sampler.restrict(masses * values)
    inside = hierarchy.vertices[:, 2] < 0.7
    error = abs(restricted - smooth_function(hierarchy.vertices))
    assert np.isfinite(restricted).all() and error[inside].mean() < 0.05 and error.max() < 2
    assert values.min() - 1e-12 <= restricted.min() and restricted.max() <= values.max() + 1e-12


def test_points_may_move():
    hierarchy = sphere_hierarchy(4)
    first, second = sphere_points(300, 1), sphere_points(300, 2)
    sampler = SphereSampler(hierarchy, first, device="cpu")
    sampler.locate(second)
    fresh = SphereSampler(hierarchy, second, device="cpu")
    values = smooth_function(hierarchy.vertices)
    np.testing.assert_array_equal(sampler.interpolate(values), fresh.interpolate(values))
    np.testing.assert_array_equal(sampler.adjoint(second[:, 0]), fresh.adjoint(second[:, 0]))
    with pytest.raises(OmtwarpError, match="expected 300 points"):
        sampler.locate(first[:10])


def test_level_for_a_budget_of_nodes():
    assert [level_for(n) for n in (12, 41, 42, 2562, 2561)] == [0, 0, 1, 4, 3]


def test_errors_name_what_is_wrong():
    with pytest.raises(OmtwarpError, match="from 0 to 10, not 11"):
        sphere_hierarchy(11)
    with pytest.raises(OmtwarpError, match="one value per node"):
        SphericalWavelets(sphere_hierarchy(1), device="cpu").forward(np.zeros(5))
    hierarchy = sphere_hierarchy(1)
    wavelets = SphericalWavelets(hierarchy, device="cpu")
    with pytest.raises(OmtwarpError, match="one value per node: must be numbers"):
        wavelets.inverse([[1.0], [1.0, 2.0]])
    for call in (lambda: wavelets.wavelet(42), lambda: wavelets.scaling_function(0, 12), lambda: wavelets.wavelet(1.5)):
        with pytest.raises(OmtwarpError, match="node: must be a whole number"):
            call()
    with pytest.raises(OmtwarpError, match="level: must be a whole number from 0 to 1"):
        wavelets.scaling_function(2, 0)
    for short in (np.ones(12), [], "abc", np.full(42, np.nan)):
        with pytest.raises(OmtwarpError, match="factors: "):
            WaveletFilter(hierarchy, short, device="cpu")
        with pytest.raises(OmtwarpError, match="damping: "):
            WaveletPreconditioner(hierarchy, damping=short, device="cpu")
        with pytest.raises(OmtwarpError, match="right_hand_side: "):
            WaveletPreconditioner(hierarchy, device="cpu").apply(short)


@pytest.mark.parametrize("name", ["analyse", "synthesise", "analyse_adjoint", "synthesise_adjoint"])
def test_recorded_transforms_launch_nothing_again_and_keep_the_bits(device, name, monkeypatch):
    hierarchy = sphere_hierarchy(4)
    direct, recorded = (SphericalWavelets(hierarchy, butterfly=True, device=device) for _ in range(2))
    monkeypatch.setattr(threads, "records_graphs", lambda device: True)
    recorded._run = GraphsByArray(device)
    values = np.random.default_rng(3).normal(size=hierarchy.node_count)
    arrays = [wp.array(values, dtype=wp.float64, device=device) for _ in range(2)]
    with step_by_step():
        for _ in range(3):
            getattr(direct, name)(arrays[0])
    getattr(recorded, name)(arrays[1])
    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", None)
        for _ in range(2):
            getattr(recorded, name)(arrays[1])
    np.testing.assert_array_equal(arrays[1].numpy(), arrays[0].numpy())
    assert (arrays[1].numpy() != values).any()


@pytest.mark.parametrize("butterfly", [False, True])
@pytest.mark.parametrize("name", ["analyse", "synthesise", "analyse_adjoint", "synthesise_adjoint"])
def test_transforms_agree_with_the_cpu_and_repeat_to_the_bit(device, name, butterfly):
    hierarchy = sphere_hierarchy(5)
    values = np.random.default_rng(8).normal(size=hierarchy.node_count)
    results = []
    for where in ("cpu", device, device):
        array = wp.array(values, dtype=wp.float64, device=where)
        getattr(SphericalWavelets(hierarchy, butterfly=butterfly, device=where), name)(array)
        results.append(array.numpy())
    np.testing.assert_allclose(results[1], results[0], rtol=1e-12, atol=1e-12 * np.abs(results[0]).max())
    np.testing.assert_array_equal(results[1], results[2])


def test_arrays_of_another_length_are_refused():
    """Kernels would read beyond the end of what is too short: every method names the array and its length."""
    hierarchy = sphere_hierarchy(2)
    sampler = SphereSampler(hierarchy, hierarchy.vertices[:50], device="cpu")
    count = hierarchy.node_count
    for call, length in [
        (sampler.interpolate, count),
        (sampler.node_gradient, count),
        (sampler.adjoint, 50),
        (sampler.set_masses, 50),
    ]:
        for wrong in (np.ones(length - 1), np.ones((length, 3)), [], "abc", np.full(length, np.nan)):
            with pytest.raises(OmtwarpError, match=r"^(values|at_points|masses): "):
                call(wrong)
    with pytest.raises(OmtwarpError, match="field: shape"):
        sampler.gradient_adjoint(np.ones((50, 2)))
    for points in ([], np.ones((4, 2)), np.full((4, 3), np.nan)):
        with pytest.raises(OmtwarpError, match="the points: "):
            SphereSampler(hierarchy, points, device="cpu")
