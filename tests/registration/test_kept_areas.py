"""Registration that keeps areas around vertices: softly, or among area-preserving maps alone."""

from __future__ import annotations

import numpy as np
import pytest
from made_cortices import BALL, EDGE, FIRM, flowed, folded, points_of, rms, unit

import omtwarp
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.registration.feature_term import FeatureField, FeatureTerm
from omtwarp.registration.strain import area_changes, areas_around, warp_energy
from omtwarp.registration.warp_shape import strain_limit, tangent_blocks

SURFACE = folded(BALL)


def stirred(points, degrees, seed=2):
    """Points after the flow of the rotated gradient of a function of degree 2, which keeps areas."""
    stretch = np.random.default_rng(seed).normal(size=(3, 3))
    stretch = stretch + stretch.T
    moved = points
    while np.degrees(np.arccos(np.clip((moved * points).sum(axis=1), -1.0, 1.0))).max() < degrees:
        middle = unit(moved + 0.5e-3 * np.cross(moved, moved @ stretch))
        moved = unit(moved + 1e-3 * np.cross(middle, middle @ stretch))
    return moved


def test_the_heavier_areas_weigh_the_better_they_are_kept():
    truth = flowed(BALL.vertices, 15.0)
    target = points_of(truth, SURFACE)
    last = np.inf
    for weight in (0.0, 3.0, 100.0):
        found = omtwarp.register(points_of(BALL.vertices, SURFACE), target, keep_areas=weight, **FIRM)
        assert found.certificate.bijective and found.largest_strain <= 2.0
        assert found.area_changes["rms"] < 0.8 * last
        last = found.area_changes["rms"]
    assert last < 0.03


def test_exact_areas_are_kept_to_a_millionth_and_the_folds_still_meet():
    """A warp that changes areas is followed as far as an area-preserving one can."""
    target = points_of(flowed(BALL.vertices, 15.0), SURFACE)
    found = omtwarp.register(points_of(BALL.vertices, SURFACE), target, keep_areas="exact", **FIRM)
    assert found.certificate.bijective
    before, after = (areas_around(sphere, BALL.faces) for sphere in (BALL.vertices, found.sphere))
    np.testing.assert_allclose(after, before, rtol=1e-6)
    assert found.area_changes["largest"] <= 1e-6
    values = found.correlations["sulc"]
    assert values["after"] > values["before"] + 0.05


def test_an_area_preserving_warp_is_found_again_exactly():
    ball, edge = shapes.icosphere(10), 1.6 * EDGE
    truth, surface = stirred(ball.vertices, 15.0), folded(ball, highest=9)
    assert area_changes(ball.vertices, truth, ball.faces)["rms"] < 0.01
    here, there = points_of(ball.vertices, surface, ball), points_of(truth, surface, ball)
    found = omtwarp.register(here, there, keep_areas="exact", **FIRM)
    assert rms(found.sphere, truth) < edge < rms(found.start.sphere, truth)
    assert found.area_changes["largest"] <= 1e-6


def test_areas_of_all_vertices_are_three_spheres():
    assert areas_around(BALL.vertices, BALL.faces).sum() == pytest.approx(12.0 * np.pi)


def test_the_energy_has_the_gradient_of_its_value_and_the_term_in_its_matrix():
    x, y, z = BALL.vertices.T
    field = FeatureField(BALL, np.column_stack([x * y + z**2]))
    share = np.full(BALL.vertex_count, 1.0 / BALL.vertex_count)
    term = FeatureTerm(np.column_stack([x * z]), share, field, np.ones(1))
    energy, without = (warp_energy(BALL, 6.0, strain_limit(2.0), one) for one in (term, None))
    moved = flowed(BALL.vertices, 5.0)
    multipliers = wp.array(np.random.default_rng(3).normal(size=BALL.vertex_count), device="cpu")

    def on_device(points):
        return wp.array(np.ascontiguousarray(points), dtype=wp.vec3d, device="cpu")

    here = on_device(moved)
    terms = energy.terms(here)
    gradient = energy.gradient(here, terms, multipliers).numpy()
    step = np.cross(moved, [0.3, 0.5, 0.8]) * (1.0 + moved[:, :1])
    ahead, behind = (
        energy.lagrangian(energy.terms(on_device(unit(moved + t * step)), multipliers)) for t in (1e-5, -1e-5)
    )
    assert float((gradient * step).sum()) == pytest.approx((ahead - behind) / 2e-5, rel=1e-2)
    energy.blocks(here, terms)
    without.blocks(here, without.terms(here))
    diagonal = energy.matrix.on_host()[0] - without.matrix.on_host()[0]
    trace = np.einsum("vdd->", tangent_blocks(here, terms.shape.at_vertices.hessian))
    assert np.einsum("vdd->", diagonal) == pytest.approx(trace) and trace > 0.0


@pytest.mark.parametrize("wrong", ["near", -1.0, np.nan])
def test_what_is_no_weight_is_refused(wrong):
    here = points_of(BALL.vertices, SURFACE)
    with pytest.raises(OmtwarpError, match=r"keep_areas \(unless 'exact'\): must be a finite") as caught:
        omtwarp.register(here, here, keep_areas=wrong)
    assert "\n" not in str(caught.value)
