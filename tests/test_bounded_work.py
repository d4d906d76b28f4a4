"""Maps of hard shapes end after bounded work, counted alike on every machine, and say what they gave up."""

from __future__ import annotations

import time

import pytest

import omtwarp
from omtwarp import map_to_sphere
from omtwarp.untangling.untangle import STEP_WORK, WORK_PER_VERTEX, RepairBudget
from tests.hostile.hostile_meshes import bipyramid, large_face, urchin

# Of one repair: the start, Moser's flow and the turns of limbs may take one each.
MOST_REPAIRS = 3.0
MOST_STEPS = 24  # of Newton's method


@pytest.fixture
def spent(monkeypatch):
    """The work of every repair, in vertices times steps."""
    work = []
    spend = RepairBudget.spend

    def counted(budget, vertices):
        work.append(vertices + STEP_WORK)
        spend(budget, vertices)

    monkeypatch.setattr(RepairBudget, "spend", counted)
    return work


def hard_map(mesh, spent):
    result = map_to_sphere(mesh, device="cpu", optimality=False)
    assert result.bijective
    assert sum(spent) <= MOST_REPAIRS * WORK_PER_VERTEX * (len(result.vertices) + STEP_WORK)
    assert len(result.history) - 1 <= MOST_STEPS
    return {stage["name"]: stage for stage in result.report["stages"]}, result.report["start"]


def test_a_face_that_cannot_keep_its_area_is_given_up_early(spent):
    """A face of 97 % of the area covers half of the sphere at most, which leaves areas around the others far off."""
    with pytest.warns(omtwarp.OmtwarpWarning, match="area"):
        stages, _ = hard_map(large_face(0.97, 5), spent)
    assert stages["omt"]["converged"] is False
    assert stages["omt"]["iterations"] <= MOST_STEPS


@pytest.mark.filterwarnings("ignore::omtwarp.errors.OmtwarpWarning")
def test_spines_take_bounded_work(spent):
    stages, _ = hard_map(urchin(20, 3.0, 6), spent)
    assert stages["omt"]["iterations"] <= MOST_STEPS


@pytest.mark.filterwarnings("ignore::omtwarp.errors.OmtwarpWarning")
def test_a_bound_that_says_nothing_is_not_raised():
    """Two fans of 10,000 triangles are mapped in 5 CPU seconds, with one bound; smaller ones get a bound that says."""
    small = map_to_sphere(bipyramid(300), device="cpu").report["optimality"]  # and kernels are compiled
    assert small["ascent_steps"] > 0 and small["gap"] < 0.5
    start = time.process_time()
    result = map_to_sphere(bipyramid(10_000), device="cpu")
    assert time.process_time() - start < 5.0
    assert result.bijective and result.report["optimality"]["ascent_steps"] == 0
    assert result.report["optimality"]["gap"] is None
