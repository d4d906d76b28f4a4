"""What area preservation means to the eye: equal circles on the sphere are equally large on the surface."""

import numpy as np
from pattern_areas import cell_areas

from omtwarp import map_to_sphere, shapes
from omtwarp.texturing import pattern


def test_equal_circles_are_equally_large_on_the_surface_with_the_optimal_map_only():
    surface = shapes.blob(seed=3, sphere=6000)
    result = map_to_sphere(surface, device="cpu")
    circles = pattern("circles", count=42)
    spread = {}
    for name in ("conformal", "sphere"):
        areas = cell_areas(circles, surface.scaled_vertices, surface.faces, getattr(result, name))
        spread[name] = np.abs(areas / areas.mean() - 1.0).max()
        if name == "sphere":
            # Each circle also has the area that it has on the sphere of the same area.
            np.testing.assert_allclose(areas, 2.0 * np.pi * (1.0 - np.cos(circles.radius)), rtol=0.025)
    assert spread["sphere"] < 0.025
    assert spread["conformal"] > 0.2
