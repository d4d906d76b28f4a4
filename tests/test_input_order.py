"""Maps of surfaces of other topology than a sphere's, which do not depend on how the input is numbered."""

import numpy as np
import pytest

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.arrays import edge_keys
from omtwarp.topology.kind import parts_of, places_of


def renumbered(vertices, faces, seed):
    """The same mesh with vertices, faces and first corners shuffled, and what its vertices and faces were before."""
    rng = np.random.default_rng(seed)
    order, rows = rng.permutation(len(vertices)), rng.permutation(len(faces))
    turned = (np.arange(3) + rng.integers(0, 3, len(faces))[:, None]) % 3
    corners = np.take_along_axis(np.argsort(order)[faces[rows]], turned, axis=1)
    return (vertices[order], corners), order, rows


def bowl(seed=3, sphere=720, height=-0.2):
    """A blob without the lower part of its sphere: one hole."""
    ball = shapes.icosphere(6)
    blob = shapes.blob(seed=seed, sphere=ball)
    kept = ball.faces[(ball.vertices[ball.faces, 2] > height).all(axis=1)]
    used, faces = np.unique(kept, return_inverse=True)
    return blob.vertices[used], faces.reshape(-1, 3)


def half_edges(polygons):
    """The sides of polygons, by keys that do not depend on their direction, the shape of the polygons."""
    ends = np.stack([polygons, np.roll(polygons, -1, axis=1)], axis=-1)
    return edge_keys(ends.reshape(-1, 2), 10**6).reshape(polygons.shape)


def with_chords(mesh):
    """The same without some faces at the rim, so that edges inside have both ends on the boundary."""
    vertices, faces = mesh
    _, numbers, counts = np.unique(half_edges(faces), return_inverse=True, return_counts=True)
    alone = (counts[numbers].reshape(-1, 3) == 1).any(axis=1)
    return vertices, np.delete(faces, np.flatnonzero(alone)[::5], axis=0)


def several(*meshes):
    counts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    vertices = np.concatenate([vertices + 5.0 * k for k, (vertices, _) in enumerate(meshes)])
    return vertices, np.concatenate([faces + count for (_, faces), count in zip(meshes, counts, strict=False)])


def ring():
    surface = shapes.rings(1, cell=0.35)
    return surface.vertices, surface.faces


def pretzel():
    surface = shapes.rings(2, cell=0.4)
    return surface.vertices, surface.faces


def ball():
    surface = shapes.blob(seed=4, sphere=320)
    return surface.vertices, surface.faces


def at_places(vertices, rows):
    """Rows in an order of their places that no numbering changes."""
    return rows[np.lexsort(vertices.T)]


CASES = {
    "hemisphere": (bowl, {"domain": "hemisphere"}),
    "hemisphere of few stages": (bowl, {"domain": "hemisphere", "until": "moser"}),
    "split edges": (lambda: with_chords(bowl()), {"domain": "hemisphere"}),
    "exact hemisphere": (lambda: with_chords(bowl()), {"domain": "hemisphere", "exact": True}),
    "disk": (bowl, {"domain": "disk"}),
    "refined disk": (bowl, {"domain": "disk", "refine": "balanced"}),
    "exact disk": (bowl, {"domain": "disk", "exact": True}),
    "cap": (bowl, {"domain": "cap"}),
    "exact cap": (bowl, {"domain": "cap", "exact": True}),
    "filled": (bowl, {"domain": "sphere"}),
    "exact filled": (bowl, {"domain": "sphere", "exact": True}),
    "cut": (pretzel, {}),
    "side by side": (lambda: several(ball(), bowl()), {"together": True}),
    "apart": (lambda: several(bowl(), ball()), {}),
}


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
@pytest.mark.parametrize(("make", "options"), CASES.values(), ids=CASES)
def test_maps_do_not_depend_on_numbers(make, options):
    """The same bits at the input's vertices and faces, and at the same places where the map has more."""
    vertices, faces = make()
    other, order, rows = renumbered(vertices, faces, seed=5)
    first, second = (omtwarp.map_surface(mesh, device="cpu", **options) for mesh in ((vertices, faces), other))
    count = len(vertices)
    for name in ("vertices", "sphere", "conformal", "density", "source", "moser", "transported", "disk"):
        one, two = getattr(first, name), getattr(second, name)
        assert (one is None) == (two is None), name
        if one is not None:
            assert np.array_equal(two[:count], one[:count][order]), name
            assert np.array_equal(at_places(second.vertices, two), at_places(first.vertices, one)), name
    assert np.array_equal(np.bincount(second.face_origin), np.bincount(first.face_origin)[rows])
    assert first.loops is None or len(first.loops) == len(second.loops) > 0
    for result, given in ((first, faces), (second, other[1])):
        assert result.certificate.bijective
        lies_as_given(result, given, count, parts=4 if options.get("exact") else 1)


def lies_as_given(result, given, count, parts):
    """Vertices and faces of the input come in its order, and all numbers of vertices fit."""
    assert np.array_equal(result.vertex_origin[:count], np.arange(count))
    assert (np.diff(result.face_origin) >= 0).all()
    origins = result.face_origin[::parts]
    whole = np.bincount(origins)[origins] == 1
    corners = result.faces if parts == 1 else result.faces.reshape(-1, 4, 3)[:, :3, 0]
    assert whole.any() and np.array_equal(result.vertex_origin[corners][whole], given[origins[whole]])
    ends = result.split_edges
    middles = 0.5 * result.vertices[ends[:, 0]] + 0.5 * result.vertices[ends[:, 1]]
    np.testing.assert_allclose(result.vertices[result.vertex_origin < 0], middles, rtol=1e-14)
    if result.loops is not None:
        for loop in np.split(result.loops, result.loop_ends[:-1]):
            assert np.isin(half_edges(loop[None]).ravel(), half_edges(result.faces)).all()
        assert np.array_equal(result.filled_vertices[: len(result.vertices)], result.vertices)
        assert np.array_equal(result.filled_sphere[: len(result.vertices)], result.sphere)
        first_faces = result.filled_faces[result.filled_loop < 0]
        assert result.part is not None or np.array_equal(first_faces, result.faces)


@pytest.mark.parametrize("options", [{}, {"exact": True}, {"refine": "balanced"}], ids=str)
def test_tori_do_not_depend_on_numbers(options):
    vertices, faces = ring()
    other, order, rows = renumbered(vertices, faces, seed=6)
    first, second = (omtwarp.map_surface(mesh, domain="torus", **options) for mesh in ((vertices, faces), other))
    count = len(vertices)
    assert np.array_equal(first.lattice, second.lattice)
    for name in ("vertices", "coordinates", "conformal"):
        one, two = getattr(first, name), getattr(second, name)
        assert np.array_equal(two[:count], one[:count][order]), name
        assert np.array_equal(at_places(second.vertices, two), at_places(first.vertices, one)), name
    if not options.get("exact"):
        assert np.array_equal(first.faces, faces) and np.array_equal(second.faces, other[1])
        turn = (faces[rows] == order[other[1][:, :1]]).argmax(axis=1)
        turned = np.take_along_axis(first.corners[rows], ((turn[:, None] + np.arange(3)) % 3)[..., None], axis=1)
        assert np.array_equal(second.corners, turned)
    for result, given in ((first, faces), (second, other[1])):
        assert result.bijective
        if options.get("exact"):
            assert np.array_equal(result.face_origin, np.repeat(np.arange(len(faces)), 4))
            assert np.array_equal(result.faces.reshape(-1, 4, 3)[:, :3, 0], given)
            assert np.array_equal(result.vertex_origin[:count], np.arange(count))


def test_parts_are_numbered_by_their_places():
    vertices, faces = several(ball(), bowl(), ring())
    other, order, _ = renumbered(vertices, faces, seed=7)
    found = []
    for mesh, names in (((vertices, faces), np.arange(len(vertices))), (other, order)):
        parts = parts_of(*mesh)
        numbered = [part.numbered_in_space() for part in parts]
        for part, given in zip(numbered, parts, strict=True):
            assert np.array_equal(mesh[0][part.vertex_origin], part.vertices) and part.genus == given.genus
            corners = part.vertex_origin[part.faces]
            assert np.array_equal(np.sort(corners, axis=1), np.sort(mesh[1][part.face_origin], axis=1))
            assert sorted(map(len, part.loops)) == sorted(map(len, given.loops))
        found.append([names[numbered[k].vertex_origin] for k in places_of(numbered)])
    assert all(np.array_equal(one, two) for one, two in zip(*found, strict=True))
