"""Maps between conformal and area preserving."""

import numpy as np
import pytest

from omtwarp.conformal import conformal_map
from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import count_flips
from omtwarp.mesh.shapes import ellipsoid
from omtwarp.mesh.surface import triangle_areas
from omtwarp.metrics import measure_triangles
from omtwarp.tradeoff import map_with_density_exponent

SURFACE = ellipsoid((1.0, 0.5, 0.4), 1200)
CONFORMAL = conformal_map(SURFACE, device="cpu").sphere


def test_area_distortion_falls_and_angle_distortion_rises_with_the_exponent(device):
    measured = [
        measure_triangles(
            SURFACE.vertices, SURFACE.faces, map_with_density_exponent(SURFACE, CONFORMAL, p, device=device)
        )
        for p in (0.0, 0.4, 0.7, 1.0)
    ]
    area, angle = ([getattr(d, what)["sphere"] for d in measured] for what in ("area", "angle"))
    assert area == sorted(area, reverse=True)
    assert angle == sorted(angle)
    assert area[-1] < 2.002
    assert angle[0] < 2.02
    assert all(d.flips == 0 for d in measured)


def test_areas_are_those_asked_for(device):
    """Areas are a μ^p, as the definition says."""
    exponent = 0.5
    sphere = map_with_density_exponent(SURFACE, CONFORMAL, exponent, weight=1000.0, device=device)
    on_sphere = triangle_areas(CONFORMAL, SURFACE.faces)
    wanted = on_sphere * (SURFACE.face_areas / on_sphere) ** exponent
    reached = triangle_areas(sphere, SURFACE.faces)
    ratio = (reached / reached.sum()) / (wanted / wanted.sum())
    assert np.abs(ratio - 1.0).mean() < 0.02
    assert count_flips(sphere, SURFACE.faces) == 0


def test_evening_out_only_helps_at_equal_area():
    """Evening out lowers the angle distortion of Moser's map alone, at nearly the same area distortion."""
    rough, even = (
        measure_triangles(
            SURFACE.vertices, SURFACE.faces, map_with_density_exponent(SURFACE, CONFORMAL, 0.6, weight=weight)
        )
        for weight in (None, 30.0)
    )
    assert even.angle["sphere"] < rough.angle["sphere"]
    assert even.area["sphere"] == pytest.approx(rough.area["sphere"], abs=0.01)


@pytest.mark.parametrize("exponent", [-0.1, 1.5, float("nan")])
def test_exponents_outside_are_refused(exponent):
    with pytest.raises(OmtwarpError, match="density exponent"):
        map_with_density_exponent(SURFACE, CONFORMAL, exponent)
