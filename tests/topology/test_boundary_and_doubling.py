"""Boundary loops, splits and doubles of surfaces with a boundary."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.validate import check
from omtwarp.topology.closing import double, split_chords
from omtwarp.topology.kind import boundary_loops, loop_length


def strip(count: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A ladder of triangles: every vertex lies on the boundary."""
    points = np.array([[k, side, 0.1 * k * side] for k in range(count) for side in (0, 1)], dtype=float)
    faces = [f for k in range(0, 2 * count - 2, 2) for f in ((k, k + 2, k + 1), (k + 1, k + 2, k + 3))]
    return points, np.array(faces)


def bowl(height: float = 0.5, frequency: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A sphere without what lies above a height."""
    ball = shapes.icosphere(frequency)
    used, faces = np.unique(ball.faces[ball.vertices[ball.faces, 2].max(axis=1) < height], return_inverse=True)
    return ball.vertices[used], faces.reshape(-1, 3)


def test_loops_are_those_of_trimesh_and_run_with_the_faces():
    ball = shapes.icosphere(6)
    open_faces = ball.faces[np.abs(ball.vertices[ball.faces, 2]).max(axis=1) < 0.7]
    used, faces = np.unique(open_faces, return_inverse=True)
    faces, points = faces.reshape(-1, 3), ball.vertices[used]
    loops = boundary_loops(faces, len(points))
    outline = trimesh.Trimesh(points, faces, process=False).outline()
    assert sorted(len(loop) for loop in loops) == sorted(len(e.points) - 1 for e in outline.entities)
    assert sum(loop_length(points, loop) for loop in loops) == pytest.approx(outline.length)
    half_edges = {(a, b) for face in faces.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True)}
    for loop in loops:
        assert loop[0] == loop.min()
        assert all((a, b) in half_edges for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))


def test_pinched_boundary_is_refused():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    with pytest.raises(OmtwarpError, match="vertex 0 more than once"):
        boundary_loops(np.array([[0, 1, 2], [0, 3, 4]]), len(points))


def test_splits_leave_the_surface_and_no_chord():
    points, faces = strip()
    split = split_chords(points, faces)
    assert len(split.split_edges) == 9  # every inner edge of ten triangles in a row
    assert np.array_equal(split.vertices[: len(points)], points)
    assert np.allclose(split.vertices[len(points) :], points[split.split_edges].mean(axis=1))
    whole = trimesh.Trimesh(points, faces, process=False).area_faces
    parts = trimesh.Trimesh(split.vertices, split.faces, process=False).area_faces
    assert np.allclose(np.bincount(split.face_origin, parts), whole)
    assert len(split_chords(split.vertices, split.faces).split_edges) == 0


@pytest.mark.parametrize("surface", [strip(), bowl(), bowl(-0.2, 5)], ids=["strip", "bowl", "shallow"])
def test_double_is_closed_of_genus_0_and_symmetric(surface):
    split = split_chords(*surface)
    glued = double(split.vertices, split.faces)
    assert not check(glued.vertices, glued.faces)
    mirror, half = glued.mirror, len(split.faces)
    assert np.array_equal(mirror[mirror], np.arange(len(mirror)))
    assert np.array_equal(mirror == np.arange(len(mirror)), glued.on_boundary)
    assert np.array_equal(glued.vertices[mirror], glued.vertices)
    assert np.array_equal(mirror[glued.faces[:half]][:, ::-1], glued.faces[half:])
