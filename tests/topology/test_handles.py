"""Loops around handles, and surfaces cut open along them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.validate import check
from omtwarp.topology.filling import fill_holes
from omtwarp.topology.handles import cut_handles, shortest_handle_loop
from omtwarp.topology.kind import parts_of


def length_of(vertices: np.ndarray, loop: np.ndarray) -> float:
    return float(np.linalg.norm(vertices[loop] - vertices[np.roll(loop, -1)], axis=1).sum())


def test_loop_on_a_ring_torus_is_its_short_circle():
    torus = trimesh.creation.torus(3.0, 1.0, major_sections=40, minor_sections=16)
    loop = shortest_handle_loop(np.asarray(torus.vertices), torus.faces)
    assert length_of(torus.vertices, loop) == pytest.approx(16 * 2.0 * np.sin(np.pi / 16))
    edges = {tuple(sorted(edge)) for edge in torus.edges_unique.tolist()}
    assert all(tuple(sorted(pair)) in edges for pair in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))
    assert shortest_handle_loop(*_arrays(shapes.icosphere(4))) is None


def _arrays(surface: omtwarp.Surface) -> tuple[np.ndarray, np.ndarray]:
    return surface.vertices, surface.faces


@pytest.mark.parametrize("genus", [1, 2, 4])
def test_cut_and_filled_surface_is_a_sphere(genus):
    vertices, faces = _arrays(shapes.rings(genus, cell=0.25))
    assert parts_of(vertices, faces)[0].genus == genus
    cut = cut_handles(vertices, faces, genus)
    assert np.array_equal(cut.vertex_origin[cut.faces], faces)
    assert np.array_equal(cut.vertices, vertices[cut.vertex_origin])
    filled = fill_holes(cut.vertices, cut.faces, [side for pair in cut.sides for side in pair])
    assert not check(filled.vertices, filled.faces)
    taken: set[int] = set()
    for one, other in cut.sides:
        origins = set(cut.vertex_origin[one].tolist())
        assert origins == set(cut.vertex_origin[other].tolist()) and not origins & taken
        assert not set(one.tolist()) & set(other.tolist())
        taken |= origins


def test_cuts_keep_clear_of_holes():
    vertices, faces = _arrays(shapes.rings(2, cell=0.2))
    kept = (vertices[faces, 1] < 1.0).all(axis=1)  # a piece of both rings is gone: the handles are left
    used, faces = np.unique(faces[kept], return_inverse=True)
    (part,) = parts_of(vertices[used], faces.reshape(-1, 3))
    cut = cut_handles(part.vertices, part.faces, part.genus)
    rim = {vertex for loop in part.loops for vertex in loop.tolist()}
    assert part.loops and not any(set(cut.vertex_origin[side].tolist()) & rim for pair in cut.sides for side in pair)


def test_pretzel_is_mapped_and_its_texture_breaks_at_the_cuts_only():
    surface = shapes.rings(2, cell=0.3)
    result = omtwarp.map_surface(surface, refine="area", device="cpu")
    assert result.report["certificate"]["bijective"] and result.distortion().flips == 0
    assert result.distortion().area["surface"] < 2.1  # coarse: areas are kept around vertices
    assert result.loop_pairs.tolist() == [[0, 1], [2, 3]]
    assert np.array_equal(result.vertex_origin[result.faces], surface.faces)
    copies = np.bincount(result.vertex_origin)
    on_loops = np.zeros(surface.vertex_count, dtype=bool)
    on_loops[result.vertex_origin[result.loops]] = True
    assert np.array_equal(copies, np.where(on_loops, 2, 1))


def test_handles_without_leave_to_cut_are_refused():
    with pytest.raises(OmtwarpError, match="--cut would map it"):
        omtwarp.map_surface(shapes.rings(2, cell=0.3), cut=False)


def test_no_loop_is_left_once_all_handles_are_cut():
    vertices, faces = _arrays(shapes.rings(1, cell=0.3))
    with pytest.raises(OmtwarpError, match="handle 2 of 2"):
        cut_handles(vertices, faces, 2)
