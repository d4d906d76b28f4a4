"""A surface's arrays on a device are the surface's, and are sent once."""

import copy
import gc
import pickle
import weakref

import numpy as np
import pytest

from omtwarp.mesh.shapes import blob
from omtwarp.mesh.surface import Surface

NAMES = ("faces", "face_areas", "vertex_areas", "face_neighbours", "edges", "edge_corners")


def test_arrays_are_those_of_the_surface_and_sent_once(device):
    surface = blob(1, sphere=640)
    mesh, again = surface.on(device), surface.on(device)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(mesh, name).numpy(), getattr(surface, name))
        assert getattr(again, name) is getattr(mesh, name)
    for sent, same, own in zip(mesh.vertex_corners, again.vertex_corners, surface.vertex_corners, strict=True):
        np.testing.assert_array_equal(sent.numpy(), own)
        assert same is sent
    assert str(mesh.faces.device) == device


@pytest.mark.parametrize("name", NAMES)
def test_on_the_cpu_nothing_is_copied(name):
    surface = blob(1, sphere=640)
    assert np.shares_memory(getattr(surface.on("cpu"), name).numpy(), getattr(surface, name))


def test_a_surface_goes_with_its_last_user():
    """A surface is freed with its last reference, not at the next garbage collection, when its memory is needed."""
    template = blob(1, sphere=640)
    gc.collect()
    gc.disable()
    try:
        surface = Surface(template.vertices, template.faces)
        sent = weakref.ref(surface.on("cpu").face_areas)
        del surface
        assert sent() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, lambda surface: pickle.loads(pickle.dumps(surface))])
def test_surfaces_are_copied_and_pickled_without_what_is_on_a_device(copied):
    """Arrays on a device hold pointers, which cannot be pickled; measures keep their bits, arrays stay read-only."""
    surface = blob(1, sphere=80)
    surface = surface.with_areas(surface.face_areas * np.linspace(1.0, 2.0, surface.face_count))
    surface.on("cpu").faces.numpy()
    again = copied(surface)
    for name in ("vertices", "faces", "face_areas", "vertex_areas"):
        assert np.array_equal(getattr(again, name), getattr(surface, name))
    assert again.checked == surface.checked and again.weighted and not again.vertices.flags.writeable
