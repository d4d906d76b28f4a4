"""Exact areas of quartered meshes in the plane and on caps, where the map to begin with is far off too."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from plane_truths import round_disk

import omtwarp
from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.mesh.surface import Surface, plane_areas
from omtwarp.open_surfaces.caps import disk_to_cap
from omtwarp.open_surfaces.held import exact_in_plane, exact_on_cap, flipped_in_plane


class Quartered(NamedTuple):
    """A quartered mesh, its vertices that stay, and the areas that its original triangles are to have."""

    surface: Surface
    held: np.ndarray
    wanted: np.ndarray

    @property
    def faces(self) -> np.ndarray:
        return self.surface.faces


def quartered_disk(rings: int) -> tuple[Quartered, np.ndarray]:
    """A round disk whose original triangles want the areas that they have, and its points; the rim on the circle."""
    flat, whole = round_disk(rings)
    sides = np.sort(np.stack([whole, np.roll(whole, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, which, shared = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    middles = len(flat) + which.reshape(-1, 3)
    parts = [np.stack([whole[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3)]
    faces = np.stack([*parts, middles], axis=1).reshape(-1, 3).astype(np.int32)
    between = flat[edges].mean(axis=1)
    rim = shared == 1
    between[rim] /= np.linalg.norm(between[rim], axis=1)[:, None]
    held = np.concatenate([np.linalg.norm(flat, axis=1) > 1.0 - 1e-9, rim])
    places = np.concatenate([flat, between])
    wanted = plane_areas(places[faces]).reshape(-1, 4).sum(axis=1)
    surface = np.concatenate([np.concatenate([flat, flat[edges].mean(axis=1)]), np.zeros((len(places), 1))], axis=1)
    return Quartered(Surface(surface, faces), held, wanted), places


def shrunken(mesh: Quartered, places: np.ndarray, power: float) -> np.ndarray:
    """The same disk with its middle shrunken: radius r goes to a power of r."""
    radius = np.linalg.norm(places, axis=1)
    return np.where(mesh.held[:, None], places, places * (radius ** (power - 1.0))[:, None])


@pytest.mark.parametrize("power", [1.05, 3.0])
def test_areas_of_a_disk(power):
    """Small errors are corrected at once; where the middle is shrunken hundreds of times, after a minimisation."""
    mesh, places = quartered_disk(7)
    begun = shrunken(mesh, places, power)
    assert not flipped_in_plane(begun, mesh.faces).any()
    found, error = exact_in_plane(begun, mesh.surface, mesh.wanted)
    areas = plane_areas(found[mesh.faces]).reshape(-1, 4).sum(axis=1)
    assert error < 1e-8
    assert np.abs(areas / mesh.wanted - 1.0).max() < 1e-8
    assert not flipped_in_plane(found, mesh.faces).any() and np.array_equal(found[mesh.held], begun[mesh.held])


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_areas_of_a_cap(share):
    mesh, places = quartered_disk(5)
    begun = disk_to_cap(shrunken(mesh, places, 2.0), share)
    found, error = exact_on_cap(begun, mesh.surface, mesh.wanted)
    areas = triangle_solid_angles(*(found[mesh.faces[:, k]] for k in range(3))).reshape(-1, 4).sum(axis=1)
    assert error < 1e-8 and np.abs(areas / areas.sum() / (mesh.wanted / mesh.wanted.sum()) - 1.0).max() < 1e-8
    assert not flipped_faces(found, mesh.faces).any()
    assert np.array_equal(found[mesh.held], begun[mesh.held])
    again, _ = exact_on_cap(found, mesh.surface, mesh.wanted)
    assert np.array_equal(again, found)


def test_refusal_is_one_line():
    mesh, places = quartered_disk(3)
    flipped = places * np.where(mesh.held, 1.0, -1.0)[:, None]
    with pytest.raises(omtwarp.OmtwarpError, match="no map with straight sides was found"):
        exact_in_plane(flipped, mesh.surface, mesh.wanted)
