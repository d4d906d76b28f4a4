"""The default map of sixty surfaces that no number of the package was chosen on."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from sphere_truths import ring_rms

import omtwarp
from omtwarp.conformal.maps import covers_once
from omtwarp.mesh.surface import SPHERE_AREA

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from random_shapes import random_shape

FIRST, COUNT, MOST_VERTICES = 100, 60, 3000


@pytest.fixture(scope="module")
def examined() -> list[dict]:
    found = []
    for seed in range(FIRST, FIRST + COUNT):
        kind, surface = random_shape(seed, MOST_VERTICES)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            result = omtwarp.map_to_sphere(surface, device="cpu")
        optimality = result.report["optimality"]
        found.append({
            "kind": f"{kind} {seed}",
            "faces": surface.face_count,
            "points": covers_once(result.conformal if result.source is None else result.source, surface.faces),
            "bijective": omtwarp.certify(surface, result.sphere, device="cpu").bijective,
            "ring": ring_rms(surface, result.sphere),
            "moved": np.sqrt(optimality["cost"] / SPHERE_AREA),
            "gap": np.inf if optimality["gap"] is None else optimality["gap"],
            "warned": any(issubclass(one.category, omtwarp.OmtwarpWarning) for one in told),
        })  # fmt: skip
    return found


def test_transport_is_measured_from_points_that_cover_the_sphere_once(examined):
    assert [one["kind"] for one in examined if not one["points"]] == []


def test_every_map_is_one_to_one(examined):
    assert [one["kind"] for one in examined if not one["bijective"]] == []


def test_areas_around_vertices_are_kept(examined):
    fine = [one for one in examined if one["faces"] >= 2000]
    off = [(one["kind"], one["ring"]) for one in fine if one["ring"] > 1e-3]
    assert len(off) <= 0.05 * len(fine), off


def test_maps_are_near_the_optimum(examined):
    moved = [one for one in examined if one["moved"] > 0.1]
    far = [(one["kind"], one["faces"], one["gap"]) for one in moved if one["gap"] > 2e-2]
    # Coarse meshes have an error of their own: of 106 other surfaces 24 are above.
    assert len(far) <= 0.3 * len(moved), far


def test_what_is_not_kept_comes_with_a_warning(examined):
    assert [one["kind"] for one in examined if one["ring"] > 0.05 and not one["warned"]] == []
