"""The barrier of strain and terms at vertices, against their definitions, differences and a minimum that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.shapes import icosphere
from omtwarp.optimal.refinement import least_distortion
from omtwarp.optimal.sphere import ShapeEnergy
from omtwarp.registration.warp_shape import VertexDerivatives, WarpShape, strain_limit


def unit(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@dataclass(frozen=True)
class Pull:
    """A spring between every vertex and a place of its own: k |x - p|² / 2, averaged."""

    places: np.ndarray
    stiffness: float

    def at(self, points):
        share = self.stiffness / len(points)
        apart = points - self.places
        hessian = np.broadcast_to(share * np.eye(3), (len(points), 3, 3))
        return VertexDerivatives(0.5 * share * float((apart**2).sum()), share * apart, hessian)


def measured(shape, sphere):
    """The terms of a map."""
    reading = Reading(resolve_device("cpu"))
    return shape.begin(vectors(sphere, "cpu"), reading)(reading.read())


@pytest.fixture(scope="module")
def bent():
    """A sphere, and a smooth map of it to itself."""
    surface = icosphere(6)
    x, y, z = surface.vertices.T
    return surface, unit(surface.vertices + 0.15 * np.stack([y * z, np.sin(2 * z), x * y], axis=1))


def stretches(source, image, faces):
    """The singular values of every triangle's linear map, by NumPy on flattened triangles."""

    def flat(points):
        a, b = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
        x = a / np.linalg.norm(a, axis=1)[:, None]
        y = np.cross(np.cross(a, b), x)
        y /= np.linalg.norm(y, axis=1)[:, None]
        return np.stack([np.stack([(e * x).sum(1), (e * y).sum(1)], axis=1) for e in (a, b)], axis=2)

    return np.linalg.svd(flat(image) @ np.linalg.inv(flat(source)), compute_uv=False)


def test_the_barrier_is_what_it_says(bent):
    surface, sphere = bent
    strain = measured(WarpShape(surface, resolve_device("cpu"), most_strain=0.6), sphere).strain
    s = stretches(surface.scaled_vertices, sphere, surface.faces)
    ratio, det = s[:, 0] / s[:, 1], s.prod(axis=1)
    w = ratio + 1 / ratio + det + 1 / det - 4
    assert 0.1 < w.max() < 0.6
    assert strain == pytest.approx(np.average(w**2 / (0.6 - w), weights=surface.face_areas), rel=1e-9)
    assert measured(WarpShape(surface, resolve_device("cpu")), sphere).strain == 0.0
    tighter = WarpShape(surface, resolve_device("cpu"), most_strain=0.9 * w.max())
    assert measured(tighter, sphere).strain == float("inf")


def test_the_limit_bounds_areas_and_stretches():
    for octaves in (0.5, 1.0, 2.0):
        limit = strain_limit(octaves)
        for ratio in (2.0**octaves, 2.0**-octaves):
            assert ratio + 1.0 / ratio - 2.0 == pytest.approx(limit)


def test_derivatives_agree_with_differences(bent):
    """The gradient is that of the value; the Hessian with no negative part cut off that of the gradient."""
    surface, sphere = bent
    term = Pull(unit(sphere + 0.1 * np.random.default_rng(1).normal(size=sphere.shape)), 3.0)
    energy = WarpShape(surface, resolve_device("cpu"), most_strain=0.6, vertex_term=term)
    gradient = energy.gradient(vectors(sphere, "cpu"), measured(energy, sphere), 1.0).numpy()
    step = np.random.default_rng(2).normal(size=sphere.shape)
    step -= (step * sphere).sum(axis=1, keepdims=True) * sphere

    def value(t):
        return measured(energy, unit(sphere + t * step)).total(1.0)

    difference = (value(1e-5) - value(-1e-5)) / 2e-5
    assert difference == pytest.approx(float((gradient * step).sum()), rel=1e-5)


def test_blocks_of_the_term_enter_the_matrix(bent):
    """Of a strong spring the Newton step leads to the places in one step."""
    surface, sphere = bent
    places = unit(sphere + 0.01 * np.random.default_rng(1).normal(size=sphere.shape))
    shape = WarpShape(surface, resolve_device("cpu"), vertex_term=Pull(places, 1e7))
    energy = ShapeEnergy(surface, resolve_device("cpu"), 1.0, shape=shape)
    points, none = energy.domain.sent(sphere), wp.zeros(surface.vertex_count, dtype=wp.float64, device="cpu")
    terms = energy.terms(points)
    energy.factorise(points, terms, none)
    _, solution = energy.newton_step(energy.gradient(points, terms, none), None)
    direction = energy.direction(solution).numpy()
    tangent = places - (places * sphere).sum(axis=1, keepdims=True) * sphere
    np.testing.assert_allclose(direction, tangent, atol=2e-4 * np.abs(tangent).max() + 1e-6)


def test_a_map_is_pulled_as_far_as_strain_allows(bent):
    """Springs that would squeeze half of the sphere into a cap: the bound is kept, and reached."""
    surface, _ = bent
    axis = np.array([0.0, 0.0, 1.0])
    places = unit(surface.vertices + 3.0 * axis)
    limit = strain_limit(1.0)
    shape = WarpShape(surface, resolve_device("cpu"), most_strain=limit, vertex_term=Pull(places, 1e3))
    given = {"shape": shape, "iterations": 100, "tolerance": 1e-6}
    found = least_distortion(surface, surface.vertices, 1.0, **given, device="cpu")
    s = np.log2(stretches(surface.scaled_vertices, found.sphere, surface.faces))
    assert found.converged and not flipped_faces(found.sphere, surface.faces).any()
    assert np.abs(s.sum(axis=1)).max() < 1.0 and (s[:, 0] - s[:, 1]).max() < 1.0
    assert np.abs(s.sum(axis=1)).max() > 0.9


def test_springs_alone_lead_home(bent):
    """From a bent start to places that an undistorted map has; the energy there is 0, of which no share is reached."""
    surface, sphere = bent
    shape = WarpShape(surface, resolve_device("cpu"), vertex_term=Pull(surface.vertices, 10.0))
    given = {"shape": shape, "iterations": 50, "tolerance": 1e-10}
    found = least_distortion(surface, sphere, 1.0, **given, device="cpu")
    assert found.history[-1]["energy"] < 1e-12
    np.testing.assert_allclose(found.sphere, surface.vertices, atol=1e-4)
