"""Hostile closed surfaces: a bijection at every stage, or one clear line."""

from __future__ import annotations

import os

import numpy as np
import pytest
from hostile_meshes import prism, random_mesh

from omtwarp.errors import OmtwarpError
from omtwarp.flips.rings import is_bijective
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import check
from omtwarp.pipeline import map_to_sphere
from omtwarp.verdict import foretell


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
    # The map keeps areas around vertices. Those of triangles differ within them: 2.12 at the minimum for (300, 0.3).
    corners = result.sphere[faces]
    dots = [(corners[:, k] * corners[:, k - 1]).sum(axis=1) for k in range(3)]
    solid = 2.0 * np.arctan2(np.linalg.det(corners), 1.0 + sum(dots))
    shares = np.bincount(faces.ravel(), np.repeat(solid, 3)) / (12.0 * np.pi)
    areas = Surface(vertices, faces).vertex_areas
    assert np.abs(shares / (areas / areas.sum()) - 1.0).max() < 1e-3
    assert result.distortion().area["surface"] < 2.15


CASES = int(os.environ.get("OMTWARP_HOSTILE_MESHES", "34"))
"""How many meshes are invented: more on request."""


@pytest.mark.parametrize("seed", range(CASES))
@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_invented_meshes_give_a_bijection_or_one_line_and_what_is_warned_of_was_foretold(seed):
    name, (vertices, faces) = random_mesh(seed)
    assert check(vertices, faces) == [], name
    foretold = foretell(Surface(vertices, faces))
    try:
        result = map_to_sphere((vertices, faces), device="cpu", optimality=False)
    except OmtwarpError as error:
        assert "\n" not in str(error) and foretold, name
        return
    for stage, sphere in every_stage(result).items():
        assert is_bijective(sphere, faces), (name, stage)
    said = result.report["warnings"]
    others = [finding for finding in said if finding["kind"] != "area-distortion"]
    if others or result.distortion().area["surface"] > 2.1:  # those just beyond the limit cannot be told beforehand
        assert foretold, (name, said)


def test_invented_meshes_are_the_same_each_time():
    name, (vertices, faces) = random_mesh(11)
    again, (points, triangles) = random_mesh(11)
    assert name == again and np.array_equal(vertices, points) and np.array_equal(faces, triangles)
