"""The weight whose refined map has a wanted area distortion, of maps that are numbers."""

import numpy as np
import pytest

from omtwarp.optimal.refinement import LEAST_WEIGHT, MOST_WEIGHT, match_area

EXACT = {"tolerance": 1e-4, "trials": 16}


def area_at(weight):
    """A distortion that falls from 7 at the least weight to 2.0005 at the largest."""
    return 2.0 + 0.5 / weight


@pytest.mark.parametrize("area", [2.001, 2.01, 2.1, 2.5])
def test_the_weight_found_has_the_area(area):
    found, weight = match_area(area_at(MOST_WEIGHT), area, lambda _, tried: area_at(tried), float, **EXACT)
    assert area - 1e-4 <= found <= area and found == area_at(weight)
    assert LEAST_WEIGHT < weight < MOST_WEIGHT


@pytest.mark.parametrize("first", [2.5, 2.01, 2.00995, np.inf, np.nan])
def test_a_first_map_that_is_near_or_above_stays(first):
    def refine(_, weight):
        raise AssertionError(weight)

    found, weight = match_area(first, 2.01, refine, float, **EXACT)
    assert (found is first or found == first) and weight == MOST_WEIGHT


def test_maps_without_a_distortion_are_refined_further_but_not_taken():
    """Each trial begins where the one before ended, whether that was taken or not."""
    begins = []

    def refine(found, weight):
        begins.append(found)
        return weight if weight > 20.0 else -weight  # a negative one has flips

    found, weight = match_area(
        MOST_WEIGHT, 2.5, refine, lambda found: area_at(found) if found > 0.0 else np.inf, tolerance=0.0, trials=16
    )
    assert found == weight > 20.0 and min(begins) < 0.0
    assert found == min(one for one in [*begins, weight] if one > 0.0)


def test_so_many_trials_and_no_less_weight_than_asked():
    tried = []
    match_area(2.0, 3.0, lambda _, weight: tried.append(weight) or 2.0, float, tolerance=1e-4, trials=7, least=10.0)
    assert len(tried) == 7 and np.all(np.diff(tried) < 0.0) and 10.0 < tried[-1] < 11.0
