"""The distortion energy against its definition, finite differences and an independent Hessian."""

from __future__ import annotations

import numpy as np
import pytest

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.mesh.shapes import blob, icosphere, needle, noisy
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.shape import DistortionEnergy, needle_weight
from omtwarp.solvers.triangle import triangle_frames
from omtwarp.start.hierarchical import hierarchical_embedding


def singular_values(points, faces):
    """Return the singular values of the Jacobian of every triangle, by NumPy's SVD on flattened triangles."""

    def flat(corners):
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        x = a / np.linalg.norm(a, axis=1)[:, None]
        y = np.cross(np.cross(a, b), x)
        y /= np.linalg.norm(y, axis=1)[:, None]
        return np.stack([np.stack([(e * x).sum(1), (e * y).sum(1)], axis=1) for e in (a, b)], axis=2)

    source, image = flat(points[0][faces]), flat(points[1][faces])
    return np.linalg.svd(image @ np.linalg.inv(source), compute_uv=False)


def measured(surface, sphere):
    """Mean area and angle distortion weighted by original area, as section 6 of the paper defines them."""
    corner = sphere[surface.faces]
    total = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    scaled = sphere * np.sqrt(SPHERE_AREA / total)
    s = singular_values((surface.scaled_vertices, scaled), surface.faces)
    weights = surface.face_areas / SPHERE_AREA
    det = s[:, 0] * s[:, 1]
    return (weights * (det + 1 / det)).sum(), (weights * (s[:, 0] / s[:, 1] + s[:, 1] / s[:, 0])).sum()


def start_map(surface):
    return hierarchical_embedding(surface, device="cpu").sphere


def tangent(sphere, seed=0):
    step = np.random.default_rng(seed).normal(size=sphere.shape)
    return step - (step * sphere).sum(axis=1, keepdims=True) * sphere


def test_energy_is_the_pair_measured(device):
    """angle and area are the weighted means, to round-off."""
    surface = noisy(blob(3, sphere=600), 0.2)
    sphere = start_map(surface)
    energy = DistortionEnergy(surface, resolve_device(device))
    terms = energy.terms(vectors(sphere, energy.device))
    area, angle = measured(surface, sphere)
    assert abs(terms.area + 2 - area) < 1e-12 * area
    assert abs(terms.angle + 2 - angle) < 1e-12 * angle
    assert 0.0 <= terms.needle < 1e-6
    expected = angle - 2 + 7 * (area - 2) + needle_weight(7.0) * terms.needle
    assert terms.total(7.0) == pytest.approx(expected, rel=1e-12)


def test_a_sphere_is_its_own_best_map(device):
    """The identity has no distortion and no gradient."""
    surface = icosphere(6)
    energy = DistortionEnergy(surface, resolve_device(device))
    points = vectors(surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True), energy.device)
    terms = energy.terms(points)
    assert 0.0 <= terms.total(100.0) < 1e-20
    assert np.abs(energy.gradient(points, terms, 100.0).numpy()).max() < 1e-12


@pytest.mark.parametrize("counted", ["by area", "by some"])
@pytest.mark.parametrize("weight", [0.5, 10.0, 300.0])
def test_gradient_matches_central_differences(weight, counted, device):
    """The gradient agrees with differences along random directions, in which the image's total area varies too."""
    surface = blob(5, sphere=500)
    sphere = start_map(surface)
    uneven = surface.face_areas * np.where(np.arange(surface.face_count) % 3 > 0, 1.0, 0.01)
    counts = surface if counted == "by area" else surface.with_areas(uneven)
    energy = DistortionEnergy(counts, resolve_device(device))
    points = vectors(sphere, energy.device)
    gradient = energy.gradient(points, energy.terms(points), weight).numpy()
    assert np.abs((gradient * sphere).sum(axis=1)).max() < 1e-10 * np.abs(gradient).max()

    def along(step, h):
        moved = sphere + h * step
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        return energy.terms(vectors(moved, energy.device)).total(weight)

    for seed in range(3):
        step = tangent(sphere, seed)
        h = 1e-6
        slope = (8 * (along(step, h) - along(step, -h)) - along(step, 2 * h) + along(step, -2 * h)) / (12 * h)
        assert slope == pytest.approx(float((gradient * step).sum()), rel=1e-6)


def test_gradient_of_the_needle_barrier():
    """An upright needle is pushed away from flipping, at the rate that differences give."""
    surface = icosphere(2)
    sphere = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    energy = DistortionEnergy(surface, resolve_device("cpu"))
    a, b, c = sphere[surface.faces[0]]
    middle = (b + c) / np.linalg.norm(b + c)
    vertex = surface.faces[0, 0]

    def bent(share):  # the first corner slides towards the middle of the edge opposite
        moved = sphere.copy()
        moved[vertex] = (1 - share) * a + share * middle
        moved[vertex] /= np.linalg.norm(moved[vertex])
        return moved

    share = 0.97
    points = vectors(bent(share), energy.device)
    terms = energy.terms(points)
    assert terms.needle > 0.0 and terms.d_volume.numpy().min() > 0.0
    h = 1e-6
    step = (bent(share + h) - bent(share - h)) / (2 * h)
    totals = [energy.terms(vectors(bent(share + k * h), energy.device)).total(10.0) for k in (1, -1)]
    slope = (totals[0] - totals[1]) / (2 * h)
    assert slope == pytest.approx(float((energy.gradient(points, terms, 10.0).numpy() * step).sum()), rel=1e-5)
    needles = [energy.terms(vectors(bent(s), energy.device)).needle for s in (0.9, 0.99, 0.999, 0.9999)]
    assert needles == sorted(needles) and needles[-1] > 50 * needles[1]
    assert needle_weight(10.0) > 0.0


def tangent_bases(sphere):
    """The bases that the kernels use, read off the kernel that leads back from them."""
    from omtwarp.device.start import wp
    from omtwarp.solvers.motion_kernels import from_tangent

    device, count = resolve_device("cpu"), len(sphere)
    bases = []
    for unit in ([1.0, 0.0], [0.0, 1.0]):
        out = wp.empty(count, dtype=wp.vec3d, device=device)
        inputs = [
            wp.array(sphere, dtype=wp.vec3d, device=device),
            wp.array(np.tile(unit, (count, 1)), dtype=wp.float64, device=device),
        ]
        wp.launch(from_tangent, dim=count, inputs=inputs, outputs=[out], device=device)
        bases.append(out.numpy().copy())
    return np.stack(bases, axis=2)


def symmetric(packed):
    """6x6 matrices of which the entries on and above the diagonal are given, row by row."""
    row, column = np.triu_indices(6)
    full = np.empty((len(packed), 6, 6))
    full[:, row, column] = full[:, column, row] = packed
    return full


def test_hessian_of_a_triangle_is_the_projection_of_the_exact_one():
    """Positive semidefinite, and the exact second derivative, cut at zero."""
    surface = blob(2, sphere=120)
    sphere = start_map(surface)
    energy = DistortionEnergy(surface, resolve_device("cpu"))
    points = vectors(sphere, energy.device)
    terms, weight = energy.terms(points), 5.0
    blocks = symmetric(energy.hessian(points, terms, weight).numpy())
    assert np.allclose(blocks, blocks.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(blocks).min() > -1e-10 * np.abs(blocks).max()
    linear, inverse = weight * terms.inverse_sum / SPHERE_AREA, weight / terms.scale
    frames, bases = triangle_frames(surface), tangent_bases(sphere)
    for t in range(0, surface.face_count, 17):
        corner = sphere[surface.faces[t]]
        p, q, r = frames[t]
        first, second = np.array([-p, p, 0.0]), np.array([-q - r, q, r])
        columns = np.stack([first @ corner, second @ corner], axis=1)
        normal = np.cross(columns[:, 0], columns[:, 1])
        normal /= np.linalg.norm(normal)
        u = columns[:, 0] / np.linalg.norm(columns[:, 0])
        plane = np.stack([u, np.cross(normal, u)])
        flat = (plane @ columns).ravel()

        def energy_of(j):
            d = j[0] * j[3] - j[1] * j[2]
            return ((j**2).sum() + inverse) / d + linear * d

        h = 1e-4 * np.abs(flat).max()
        exact = np.empty((4, 4))
        units = h * np.eye(4)
        for a in range(4):
            for b in range(4):
                exact[a, b] = (
                    energy_of(flat + units[a] + units[b])
                    - energy_of(flat + units[a] - units[b])
                    - energy_of(flat - units[a] + units[b])
                    + energy_of(flat - units[a] - units[b])
                ) / (4 * h * h)
        values, directions = np.linalg.eigh(exact)
        cut = (directions * np.maximum(values, 0.0)) @ directions.T
        # How the in-plane Jacobian depends on the six tangent coordinates.
        chain = np.empty((4, 6))
        for i in range(3):
            for v in range(2):
                moved = plane @ bases[surface.faces[t, i], :, v]
                chain[:, 2 * i + v] = np.outer(moved, [first[i], second[i]]).ravel()
        expected = surface.face_areas[t] / SPHERE_AREA * chain.T @ cut @ chain
        assert np.allclose(blocks[t], expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_frames_flatten_triangles():
    """Frames are of flattened triangles: the identity's Jacobian has orthonormal columns, also in needles."""
    surface = needle(20.0, 300)
    p, q, r = triangle_frames(surface).T
    corner = surface.scaled_vertices[surface.faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    c1, c2 = p[:, None] * first, q[:, None] * first + r[:, None] * second
    gram = np.stack([(c1 * c1).sum(1), (c1 * c2).sum(1), (c2 * c2).sum(1)])
    assert np.allclose(gram, np.array([1.0, 0.0, 1.0])[:, None], atol=1e-10)
    assert np.allclose(1 / (2 * p * r), surface.face_areas, rtol=1e-9)


def test_sums_of_distortion_agree_with_numpy(device, monkeypatch):
    surface = noisy(blob(4, amplitude=0.3, sphere=1500), 0.2)
    sphere = hierarchical_embedding(surface, device="cpu").sphere
    energy = DistortionEnergy(surface, wp.get_device("cpu"))
    truth = energy.terms(vectors(sphere, energy.device))
    other = DistortionEnergy(surface, wp.get_device(device))
    monkeypatch.setattr("omtwarp.device.sums.sums_for", DeviceSum)
    got = other.terms(vectors(sphere, other.device))
    for name in ("angle", "area", "scale", "inverse_sum"):
        assert getattr(got, name) == pytest.approx(getattr(truth, name), rel=1e-12)
    assert got.needle == pytest.approx(truth.needle, rel=1e-12)
    np.testing.assert_allclose(got.ratio.numpy(), truth.ratio.numpy(), rtol=1e-12)
    np.testing.assert_allclose(got.d_volume.numpy(), truth.d_volume.numpy(), rtol=1e-11)
