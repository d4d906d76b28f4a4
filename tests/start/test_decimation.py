"""Every level of the hierarchy is a closed genus-0 mesh, and every round keeps the invariants."""

import numpy as np
import pytest
import trimesh

from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, flip_edges, icosphere, limbs, tube, uv_sphere
from omtwarp.mesh.surface import Surface
from omtwarp.start.decimation import simplify

CPU = resolve_device("cpu")
SHAPES = {
    "blob": lambda: blob(3, sphere=1280),
    "tube": lambda: tube(length=10.0, face_count=1000),
    "limbs": lambda: limbs(sphere=1280),
    "irregular": lambda: flip_edges(icosphere(8), rounds=30, seed=1),
    "poles of degree 200": lambda: uv_sphere(rings=4, segments=200),
    "octahedron": lambda: uv_sphere(rings=1, segments=4),
}


def level_faces(level):
    """Every face once, from the half-edges, in the order of the faces."""
    tails = np.repeat(level.vertices, np.diff(level.offsets))
    faces = np.empty((len(level.face_masses), 3), dtype=np.int64)
    faces[level.half_edge_faces] = np.stack([tails, level.heads, level.thirds], axis=1)
    return faces


@pytest.mark.parametrize("name", SHAPES)
def test_every_level_is_a_closed_sphere_with_the_whole_mass(name):
    """Each edge lies in two faces in opposite directions, V - F / 2 = 2 and the masses sum to 4 pi."""
    surface = SHAPES[name]()
    hierarchy = simplify(surface, CPU)
    for level in hierarchy.levels:
        faces = level_faces(level)
        assert len(level.vertices) - len(faces) // 2 == 2
        assert np.array_equal(np.unique(faces), level.vertices)
        forward = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        edges = {tuple(e) for e in forward}
        assert len(edges) == len(forward)
        assert all((b, a) in edges for a, b in edges)
        assert level.face_masses.min() > 0
        assert level.face_masses.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    assert len(hierarchy.levels[-1].vertices) == 4


@pytest.mark.parametrize("name", SHAPES)
def test_removed_vertices_are_no_neighbours_and_their_rings_survive(name):
    """No ring holds a vertex of its own round, and the ring is the vertex's link in the finer level."""
    hierarchy = simplify(SHAPES[name](), CPU)
    for level, coarser, removal in zip(hierarchy.levels, hierarchy.levels[1:], hierarchy.removals, strict=False):
        assert np.array_equal(np.setdiff1d(level.vertices, removal.vertices), coarser.vertices)
        fine = {frozenset(np.roll(f, k)[:2]) for f in level_faces(level) for k in range(3)}
        for v, ring, valence in zip(removal.vertices, removal.rings, removal.valences, strict=True):
            ring = ring[:valence]
            row = np.searchsorted(level.vertices, v)
            neighbours = level.heads[level.offsets[row] : level.offsets[row + 1]]
            assert np.array_equal(np.sort(ring), neighbours)
            assert not np.isin(ring, removal.vertices).any()
            assert all(frozenset(pair) in fine for pair in zip(ring, np.roll(ring, -1), strict=True))


def test_rounds_are_few():
    """A round removes a constant part of the vertices, so their number grows with the logarithm of the mesh."""
    rounds = [len(simplify(icosphere(n), CPU).removals) for n in (8, 16, 32)]
    assert rounds[2] < 60
    assert rounds[2] - rounds[1] < 15 and rounds[1] - rounds[0] < 15


def test_long_limbs_keep_their_samples():
    """Simplification keeps limbs: halfway down, either half of a tube has about half of the vertices."""
    surface = tube(length=20.0, face_count=4000)
    level = next(x for x in simplify(surface, CPU).levels if len(x.vertices) < 200)
    along = surface.vertices - surface.vertices.mean(axis=0)
    axis = np.linalg.svd(along, full_matrices=False)[2][0]
    assert 0.4 < (along[level.vertices] @ axis > 0).mean() < 0.6


def with_first_reversed(faces):
    return np.concatenate([faces[:1, ::-1], faces[1:]])


def two(first, second):
    vertices = np.concatenate([first.vertices, np.asarray(second.vertices) + 10.0])
    return Surface(vertices, np.concatenate([first.faces, np.asarray(second.faces) + len(first.vertices)]))


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (lambda: Surface(icosphere(3).vertices, icosphere(3).faces[1:]), "closed"),
        (lambda: Surface(icosphere(3).vertices, with_first_reversed(icosphere(3).faces)), "closed"),
        (lambda: Surface(np.r_[icosphere(3).vertices, [[9, 9, 9]]], icosphere(3).faces), "no face uses"),
        (lambda: Surface(np.zeros((0, 3)), np.zeros((0, 3))), "no face uses"),
        (lambda: two(icosphere(2), icosphere(2)), "Euler number 4"),
        (lambda: two(icosphere(2), trimesh.creation.torus(2, 0.5)), "genus 0"),
    ],
    ids=["open", "reversed face", "unused vertex", "empty", "two spheres", "sphere and torus"],
)
def test_what_is_not_a_sphere_is_refused(surface, words):
    """The message names the defect; a sphere beside a torus has Euler number 2 and is found out on the way."""
    with pytest.raises(OmtwarpError, match=words):
        simplify(surface(), CPU)
