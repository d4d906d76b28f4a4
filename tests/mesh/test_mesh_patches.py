"""Patches: freed vertices, their fixed neighbours, and the pieces."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings, strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.shapes import icosphere


def test_grow_counts_rings():
    """One ring of a vertex of valence 5 or 6 is its neighbours."""
    surface = icosphere(4)
    seed = np.zeros(surface.vertex_count, dtype=bool)
    seed[0] = True
    edges = surface.edges[(surface.edges == 0).any(axis=1)]
    assert set(np.flatnonzero(grow(surface.faces, seed, 1))) == set(edges.ravel())
    assert grow(surface.faces, seed, 100).all()


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), share=st.floats(0.01, 0.9))
def test_patches_of_random_vertices(seed, share):
    """Every triangle with a freed corner once; pieces as the edges between freed vertices link them."""
    surface = icosphere(6)
    rng = np.random.default_rng(seed)
    freed = rng.random(surface.vertex_count) < share
    freed[0] = True
    patches = Patches.of_vertices(surface.faces, freed)
    edges = surface.edges[freed[surface.edges].all(axis=1)]
    links = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(freed), len(freed)))
    piece = connected_components(links, directed=False)[1]
    assert set(patches.vertices[: patches.free]) == set(np.flatnonzero(freed))
    assert len(set(patches.vertices)) == len(patches.vertices)
    np.testing.assert_array_equal(patches.triangles, np.flatnonzero(freed[surface.faces].any(axis=1)))
    np.testing.assert_array_equal(patches.vertices[patches.faces], surface.faces[patches.triangles])
    assert set(patches.vertices) == set(surface.faces[patches.triangles].ravel())
    own = piece[patches.vertices[: patches.free]]
    assert patches.count == len(set(own)) == len(set(zip(own, patches.vertex_patch, strict=True)))
    assert set(patches.vertex_patch) == set(range(patches.count))
    for corners, patch in zip(patches.faces, patches.face_patch, strict=True):
        assert {int(patches.vertex_patch[c]) for c in corners if c < patches.free} == {int(patch)}
