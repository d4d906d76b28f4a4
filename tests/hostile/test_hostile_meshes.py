"""Whatever closed surface comes: a bijection at every stage, or one clear line."""

from __future__ import annotations

import pytest
from hostile_meshes import prism

from omtwarp.flips.rings import is_bijective
from omtwarp.pipeline import map_to_sphere


def every_stage(result):
    """The maps that a result holds, by name."""
    maps = {name: getattr(result, name) for name in ("conformal", "moser", "transported", "sphere")}
    return {name: sphere for name, sphere in maps.items() if sphere is not None}


@pytest.mark.parametrize(("count", "height"), [(250, 0.5), (300, 0.3), (300, 0.5), (300, 1.0), (20, 30.0)])
def test_prisms_with_caps_of_long_triangles(count, height):
    """Repair of their flipped triangles used to end without flips in maps that cover the sphere two or three times."""
    vertices, faces = prism(count, height)
    result = map_to_sphere((vertices, faces))
    for name, sphere in every_stage(result).items():
        assert is_bijective(sphere, faces), name
    assert result.bijective
    assert result.distortion().area["surface"] < 2.1
