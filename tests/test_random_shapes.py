"""A sample of the random shapes of ``examples/random_shapes.py``: bijective at every stage, whatever the shape."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from omtwarp.mesh.shapes import blob
from omtwarp.mesh.surface import triangle_areas
from omtwarp.mesh.validate import check

SCRIPT = Path(__file__).parent.parent / "examples" / "random_shapes.py"
# One of every kind; tests/test_generated_surfaces.py maps five of each.
SEEDS = range(12)
MOST_VERTICES = 800


def _script():
    specification = importlib.util.spec_from_file_location("random_shapes", SCRIPT)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


random_shapes = _script()


@pytest.mark.parametrize("seed", SEEDS)
def test_every_stage_is_a_bijection(seed):
    _, surface = random_shapes.random_shape(seed, MOST_VERTICES)
    found = random_shapes.examine(surface)
    assert found["flips"] == "0/0/0"
    assert found["degrees"] == "1/1/1"
    assert found["bijective"]
    # Areas are kept around vertices; those of triangles follow as far as a coarse mesh lets them: these have a few
    # hundred vertices, and some only a handful around a limb.
    assert found["area"] < 2.3


@pytest.mark.parametrize("seed", SEEDS)
def test_shapes_are_sound_and_the_same_every_time(seed):
    kind, surface = random_shapes.random_shape(seed, MOST_VERTICES)
    again = random_shapes.random_shape(seed, MOST_VERTICES)
    assert kind == again[0] == list(random_shapes.KINDS)[seed % len(random_shapes.KINDS)]
    np.testing.assert_array_equal(surface.vertices, again[1].vertices)
    np.testing.assert_array_equal(surface.faces, again[1].faces)
    assert check(surface.vertices, surface.faces) == []
    assert random_shapes.LEAST_VERTICES <= surface.vertex_count <= 1.25 * MOST_VERTICES


@pytest.mark.parametrize("wanted", [300, 100, 40])
def test_collapsing_edges_keeps_a_surface_sound(wanted):
    """As many vertices as asked for, each one of the old, closed, of genus 0, and no triangle turned inside out."""
    surface = blob(seed=4, amplitude=0.2, degree=4, sphere=1280)
    coarse = random_shapes.collapse_edges(surface, wanted, seed=3)
    assert coarse.vertex_count == wanted
    assert coarse.face_count == 2 * wanted - 4
    assert check(coarse.vertices, coarse.faces) == []
    old = {tuple(point) for point in surface.vertices.tolist()}
    assert all(tuple(point) in old for point in coarse.vertices.tolist())


def test_quartering_gives_four_faces_for_one_and_rounds_no_volume_away():
    surface = blob(seed=4, amplitude=0.2, degree=4, sphere=1280)
    fine = random_shapes.quartered(surface)
    assert fine.face_count == 4 * surface.face_count
    assert check(fine.vertices, fine.faces) == []
    areas = [triangle_areas(s.vertices, s.faces).sum() for s in (surface, fine)]
    assert areas[1] == pytest.approx(areas[0], rel=0.02)
