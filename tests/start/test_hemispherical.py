"""Starts of surfaces with a boundary: no triangle flips, the boundary is on the equator, all else north of it."""

import numpy as np
import pytest

from omtwarp import OmtwarpError, repair, shapes
from omtwarp.device.policy import resolve_device
from omtwarp.flips.exact import count_flips, is_bijective
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.open_surfaces.symmetric import ACROSS
from omtwarp.start.decimation import Vertex, simplify
from omtwarp.start.hierarchical import hemispherical_embedding
from omtwarp.topology.closing import double, split_chords
from omtwarp.topology.kind import boundary_half_edges, boundary_loops, parts_of


def part_above(surface, level):
    """The largest piece of the triangles above a share of a surface's height, chords split."""
    height = surface.vertices[:, 2]
    above = height > height.min() + level * np.ptp(height)
    kept = repair(surface.vertices, surface.faces[above[surface.faces].all(axis=1)], whole=False)
    part = max(parts_of(kept.vertices, kept.faces), key=lambda each: len(each.faces))
    assert len(boundary_loops(part.faces, len(part.vertices))) == 1
    return split_chords(part.vertices, part.faces)


SHAPES = {
    "ball": lambda: part_above(shapes.icosphere(8), 0.4),
    "blob": lambda: part_above(shapes.blob(seed=4, sphere=1280), 0.5),
    "thin limbs": lambda: part_above(
        shapes.limbs([[0.0, 0.0, 1.0], [1.0, 0.0, 0.3]], length=8.0, sharpness=9.0, sphere=1280), 0.1
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_map_and_its_mirror_image_are_one_to_one(name):
    part = SHAPES[name]()
    sphere = hemispherical_embedding(part.vertices, part.faces, device="cpu")
    on_rim = np.zeros(len(sphere), dtype=bool)
    on_rim[boundary_half_edges(part.faces, len(sphere))] = True
    assert (sphere[on_rim, 2] == 0.0).all() and (sphere[~on_rim, 2] > 0.0).all()
    assert np.abs(np.linalg.norm(sphere, axis=1) - 1.0).max() < 1e-14
    assert count_flips(sphere, part.faces) == 0
    glued = double(part.vertices, part.faces)
    whole = np.concatenate([sphere, (sphere * ACROSS)[~on_rim]])
    assert is_bijective(whole, glued.faces)


def test_areas_are_roughly_kept_where_a_conformal_map_shrinks_limbs():
    part = SHAPES["thin limbs"]()
    sphere = hemispherical_embedding(part.vertices, part.faces, device="cpu")
    own, image = triangle_areas(part.vertices, part.faces), triangle_areas(sphere, part.faces)
    ratio = image / image.sum() * own.sum() / own
    assert (own * (ratio + 1.0 / ratio)).sum() / own.sum() < 2.2


def test_given_areas_decide_in_place_of_those_of_triangles():
    part = SHAPES["ball"]()
    wanted = np.where(part.vertices[part.faces].mean(axis=1)[:, 0] > 0.0, 4.0, 1.0)
    wanted = wanted * triangle_areas(part.vertices, part.faces)
    images = [
        triangle_areas(hemispherical_embedding(part.vertices, part.faces, areas, device="cpu"), part.faces)
        for areas in (None, wanted)
    ]
    errors = [np.abs(image / image.sum() - wanted / wanted.sum()).sum() for image in images]
    assert errors[1] < 0.25 * errors[0]


@pytest.mark.parametrize("name", SHAPES)
def test_the_boundary_stays_a_loop_without_chords(name):
    part = SHAPES[name]()
    count = len(part.vertices)
    rim = boundary_half_edges(part.faces, count)
    kinds = np.full(count + 1, Vertex.INSIDE, dtype=np.int32)
    kinds[rim], kinds[count] = Vertex.RIM, Vertex.POLE
    fan = np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), count)], axis=1)
    centre = part.vertices[rim[:, 0]].mean(axis=0)
    closed = Surface(np.vstack([part.vertices, centre]), np.vstack([part.faces, fan]).astype(np.int32))
    levels = simplify(closed, resolve_device("cpu"), kinds=kinds).levels
    for level in levels:
        tails = np.repeat(level.vertices, np.diff(level.offsets))
        along = (kinds[tails] == Vertex.RIM) & (kinds[level.heads] == Vertex.RIM)
        assert along.sum() == 2 * (kinds[level.vertices] == Vertex.RIM).sum()
        assert count in level.vertices
    assert np.bincount(kinds[levels[-1].vertices], minlength=3).tolist() == [1, 3, 1]


def test_a_disk_without_a_vertex_inside_is_refused():
    with pytest.raises(OmtwarpError, match="simplification stopped"):
        hemispherical_embedding(np.eye(3), np.array([[0, 1, 2]], dtype=np.int32), device="cpu")
