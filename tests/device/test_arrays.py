"""Stages take maps as NumPy's arrays or as Warp's, with the same results, and do not change them."""

import numpy as np
import pytest

from omtwarp.conformal import conformal_map
from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.start import wp
from omtwarp.flips.exact import count_flips, flipped_faces
from omtwarp.mesh.shapes import blob
from omtwarp.metrics import measure_triangles
from omtwarp.moser import moser_map
from omtwarp.transport.cost import transport_cost
from omtwarp.transport.flow import optimal_transport

SURFACE = blob(1, sphere=1280)


@pytest.fixture(scope="module")
def start():
    return conformal_map(SURFACE, device="cpu").sphere


def test_on_the_cpu_only_other_types_are_copied():
    points, faces = SURFACE.vertices, SURFACE.faces
    assert np.shares_memory(vectors(points, wp.get_device("cpu")).numpy(), points)
    assert np.shares_memory(triangles(faces, wp.get_device("cpu")).numpy(), faces)
    single = points.astype(np.float32)
    np.testing.assert_array_equal(vectors(single, wp.get_device("cpu")).numpy(), single.astype(np.float64))
    np.testing.assert_array_equal(triangles(faces.astype(np.int64), wp.get_device("cpu")).numpy(), faces)


def test_an_array_on_the_device_is_taken_as_it_is(device):
    where = wp.get_device(device)
    sent = vectors(SURFACE.vertices, where)
    assert vectors(sent, where) is sent
    np.testing.assert_array_equal(sent.numpy(), SURFACE.vertices)


def test_stages_take_either_and_change_neither(start, device):
    given = start.copy()
    sent = wp.array(start, dtype=wp.vec3d, device=device)
    maps = {}
    for name, begin in (("numpy", given), ("warp", sent)):
        moser = moser_map(SURFACE, begin, device=device).sphere
        initial = moser if name == "numpy" else wp.array(moser, dtype=wp.vec3d, device=device)
        moved = optimal_transport(SURFACE, initial, start=begin, device=device, iterations=3).sphere
        last = moved if name == "numpy" else wp.array(moved, dtype=wp.vec3d, device=device)
        maps[name] = moser, moved, transport_cost(SURFACE, last, start=begin, device=device)
    for one, other in zip(maps["numpy"], maps["warp"], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(given, start)
    np.testing.assert_array_equal(sent.numpy(), start)


def test_measures_take_either(start, device):
    mesh = SURFACE.on(device)
    mirrored = start.copy()
    mirrored[: len(start) // 2, 0] *= -1.0  # flips many triangles
    sent = wp.array(mirrored, dtype=wp.vec3d, device=device)
    flipped = flipped_faces(mirrored, SURFACE.faces)
    assert 0 < flipped.sum() == count_flips(sent, mesh.faces, device=device)
    np.testing.assert_array_equal(flipped_faces(sent, mesh.faces, device=device), flipped)
    one = measure_triangles(SURFACE.vertices, SURFACE.faces, start, device=device)
    other = measure_triangles(mesh.vertices, mesh.faces, start, device=device)
    assert one.to_dict() == other.to_dict()


def test_what_floating_point_cannot_decide_is_decided_on_arrays_of_the_device_too(device):
    """Signs are exact for three points in a plane with the origin, and with one coordinate changed by its last bit."""
    points = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, -1.0, 0], [-1.0, -1.0, 5e-324]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 3]], dtype=np.int32)
    sent = wp.array(points, dtype=wp.vec3d, device=device), wp.array(faces, dtype=wp.vec3i, device=device)
    np.testing.assert_array_equal(flipped_faces(*sent, device=device), [True, False, True])
