"""A minimisation stays on the device: how often the host reads from it does not depend on the mesh."""

import numpy as np
import pytest

import omtwarp
from omtwarp.device.policy import solving_with
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.shapes import blob
from omtwarp.optimal.exact import exact_map
from omtwarp.options import Solver

# Before the first step and after the last: points x, first numbers, map, multipliers.
AROUND = 4


def start_of(faces):
    surface = blob(seed=3, amplitude=0.25, sphere=faces)
    x = omtwarp.conformal_map(surface).sphere
    return surface, x, omtwarp.moser_map(surface, x).sphere


def reads_of_a_step(fake, minimised):
    """Run a minimisation on the fake device with cuDSS; return reads per step, and how many steps there were."""
    with solving_with(Solver.CUDSS, "cuda:0"):
        fake.downloads.clear()
        steps = len(minimised().history) - 1
    return (sum(fake.downloads.values()) - AROUND) / steps, steps


@pytest.mark.parametrize("faces", [320, 2000])
def test_steps_of_the_optimal_map(fake, library, faces):
    surface, x, y = start_of(faces)
    reads, steps = reads_of_a_step(fake, lambda: omtwarp.optimal_map(surface, y, start=x, gain=1e-8, device="cuda:0"))
    assert reads <= 4.0 and steps > 1  # one is of the map with corrected areas


@pytest.mark.parametrize("faces", [320, 2000])
@pytest.mark.parametrize("weight", ["angle", 30.0])
def test_steps_of_a_refinement(fake, library, faces, weight):
    surface, _, y = start_of(faces)
    reads, steps = reads_of_a_step(fake, lambda: omtwarp.refine_map(surface, y, weight=weight, device="cuda:0"))
    assert reads <= 3.0 and steps > 1


def test_steps_to_exact_areas(fake, library):
    """The reads of the correction of areas at the end are those of its own steps, which it does not report as such."""
    surface, x, y = start_of(320)
    parts = quarter(surface)
    given = parts.on_sphere(omtwarp.optimal_map(surface, y, start=x).sphere)
    reads, steps = reads_of_a_step(fake, lambda: exact_map(parts, given, start=parts.on_sphere(x), device="cuda:0"))
    assert reads <= 3.0 and steps > 1


def test_the_host_s_factorisation_reads_the_system_as_well(fake):
    """Matrix and right-hand side of every step and of its correction, three reads more, and a first right-hand side."""
    surface, x, y = start_of(320)
    fake.downloads.clear()
    found = omtwarp.optimal_map(surface, y, start=x, device="cuda:0")
    assert sum(fake.downloads.values()) <= 7 * (len(found.history) - 1) + AROUND + 1
    host = omtwarp.optimal_map(surface, y, start=x, device="cpu")
    np.testing.assert_allclose(found.sphere, host.sphere, rtol=0.0, atol=1e-11)
