"""The energy of maps to a torus: its derivatives against differences, and its areas against Euclid's."""

import numpy as np
import pytest

from omtwarp.device.start import wp
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.shapes import rings
from omtwarp.optimal.cells import TriangleCells
from omtwarp.optimal.energy import TransportEnergy
from omtwarp.torus.harmonic import conformal_torus
from omtwarp.torus.mapping import quartered_torus
from omtwarp.torus.transport import TorusMaps


@pytest.fixture(scope="module", params=["around vertices", "of triangles"])
def energy_and_map(request) -> tuple[TransportEnergy, np.ndarray]:
    surface = rings(1, cell=0.4)
    flat = conformal_torus(surface)
    if request.param == "around vertices":
        energy = TorusMaps(surface, flat).energy(0.02)
    else:
        parts = quarter(surface)
        flat = quartered_torus(parts, surface.faces, flat)
        energy = TorusMaps(parts.surface, flat).energy(0.02, cells=TriangleCells(parts, wp.get_device("cpu")))
    return energy, flat.points + 1e-3 * np.random.default_rng(3).normal(size=flat.points.shape)


def test_gradient_is_the_derivative(energy_and_map):
    energy, y = energy_and_map
    multipliers = wp.array(np.random.default_rng(0).normal(size=len(energy.wanted)) * 0.1, device="cpu")

    def value(points):
        return energy.lagrangian(energy.terms(energy.domain.sent(points), multipliers))

    here = energy.domain.sent(y)
    gradient = energy.gradient(here, energy.terms(here), multipliers).numpy()
    for seed in range(3):
        step = 1e-6 * np.random.default_rng(seed).normal(size=y.shape)
        difference = (value(y + step) - value(y - step)) / 2
        assert difference == pytest.approx(float((gradient * step).sum()), rel=1e-6, abs=1e-12)


def test_slopes_are_derivatives_of_the_areas(energy_and_map):
    energy, y = energy_and_map
    here = energy.domain.sent(y)
    energy.blocks(here, energy.terms(here))
    slopes = energy.matrix.slopes.numpy()
    step = 1e-6 * np.random.default_rng(1).normal(size=y.shape)
    if isinstance(energy.cells, TriangleCells):
        change = (slopes.reshape(-1, 6, 2) * step[energy.cells.vertices]).sum(axis=(1, 2))
    else:
        # The area around a vertex does not depend on where the vertex itself is: only its neighbours count.
        slopes = slopes.reshape(2, -1, 2)
        i, j = energy.surface.edges.T
        change = np.bincount(i, (slopes[0] * step[j]).sum(1), len(y))
        change += np.bincount(j, (slopes[1] * step[i]).sum(1), len(y))
    ahead, behind = (energy.terms(energy.domain.sent(y + s * step)).areas.numpy() for s in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2, change, atol=1e-10)


def test_areas_cover_the_torus(energy_and_map):
    energy, y = energy_and_map
    triangles = energy.domain.areas(energy.domain.sent(y)).numpy()
    assert triangles.sum() == pytest.approx(4.0 * np.pi, rel=1e-12)
    masses = energy.cells.masses(energy.cells.areas(energy.domain.areas(energy.domain.sent(y))), 1.0).numpy()
    assert masses.sum() == pytest.approx(4.0 * np.pi, rel=1e-12)
    assert not energy.domain.flipped(y).any()
    assert energy.domain.flipped(y @ np.diag([1.0, -1.0])).any()
