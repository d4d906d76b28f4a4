"""Every defect is found, counted and located, with its remedy; valid meshes at any scale have none."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import Topology, check, require_valid
from omtwarp.mesh.write import write_mesh


def ball() -> tuple[np.ndarray, np.ndarray]:
    """A geodesic sphere, 92 vertices and 180 faces, free to be spoiled."""
    sphere = shapes.icosphere(3)
    return sphere.vertices.copy(), sphere.faces.astype(np.int64)


def torus(m: int = 12, n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """A torus as a periodic grid, outward."""
    u, v = np.meshgrid(2 * np.pi * np.arange(m) / m, 2 * np.pi * np.arange(n) / n, indexing="ij")
    ring = 2 + 0.7 * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), 0.7 * np.sin(v)], axis=2).reshape(-1, 3)
    at = np.arange(m * n).reshape(m, n)
    right, up = np.roll(at, -1, axis=0), np.roll(at, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    return vertices, np.concatenate([np.stack(t, axis=2).reshape(-1, 3) for t in ((at, right, both), (at, both, up))])


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = zip(*parts, strict=True)
    starts = np.cumsum([0, *map(len, vertices[:-1])])
    return np.concatenate(vertices), np.concatenate([f + s for f, s in zip(faces, starts, strict=True)])


def spoiled() -> dict[str, tuple]:
    """Return cases by name: vertices, faces, kind of the first defect, count, place, and words of its line."""
    cases = {}
    v, f = ball()
    cases["no faces"] = (v, f[:0], "empty", 1, -1, "92 vertices and 0 faces")
    cases["nothing"] = ([], [], "empty", 1, -1, "0 vertices and 0 faces")
    cases["quads"] = (v, np.zeros((5, 4), int), "not-a-triangle-mesh", 1, -1, "5 faces with 4 corners, triangulate")
    cases["ragged"] = (v, [[0, 1, 2], [0, 1]], "not-a-triangle-mesh", 1, -1, "rows of equal length")
    cases["planar"] = (v[:, :2], f, "not-a-triangle-mesh", 1, -1, "[92, 2]")
    cases["half indices"] = (v, f + 0.5, "not-a-triangle-mesh", 1, -1, "whole numbers")

    g = f.copy()
    g[[7, 20], 1] = [92, -1]
    cases["out of range"] = (v, g, "index-out-of-range", 2, 7, "first face 7")
    w = v.copy()
    w[[5, 9], [0, 2]] = [np.nan, np.inf]
    cases["not finite"] = (w, f, "non-finite", 2, 5, "2 vertices with NaN or infinite coordinates, first vertex 5")
    g = np.concatenate([f, f[[3]][:, [1, 2, 0]]])
    cases["duplicate face"] = (v, g, "duplicate-faces", 1, 180, "first face 180")
    cases["duplicate turned"] = (v, np.concatenate([f[[3]][:, ::-1], f]), "duplicate-faces", 1, 4, "1 duplicate face")
    g = f.copy()
    g[11, 2] = g[11, 0]
    cases["repeated vertex"] = (v, g, "zero-area", 1, 11, "1 face of zero area, first face 11")
    w = v.copy()
    w[f[40, 2]] = w[f[40, 0]]  # two faces share the edge that now has no length
    cases["zero area"] = (w, f, "zero-area", 2, None, "2 faces of zero area")
    w = v.copy()
    w[f[40, 2]] = (w[f[40, 0]] + w[f[40, 1]]) / 2
    cases["on a line"] = (w, f, "zero-area", 1, 40, "first face 40 (")
    cases["one point"] = (np.ones_like(v), f, "zero-area", 180, 0, "180 faces of zero area")
    w = np.concatenate([v, v[:2] * 2])
    cases["unused"] = (w, f, "unused-vertices", 2, 92, "2 vertices in no face, first vertex 92")

    fin = np.concatenate([f, [[f[0, 0], f[0, 1], 92]]])
    cases["fin"] = (np.concatenate([v, [[3.0, 0, 0]]]), fin, "non-manifold-edges", 1, None, "more than two faces")
    w, g = joined((v, f), (v + [2.0, 0, 0], f))
    east, west = np.argmax(v[:, 0]), 92 + np.argmin(v[:, 0])
    g[g == west] = east
    w, g = np.delete(w, west, axis=0), np.where(g > west, g - 1, g)
    cases["touching"] = (w, g, "non-manifold-vertices", 1, int(east), "several fans of faces meet in a point")
    cases["hole"] = (v, f[1:], "open-boundary", 3, None, "3 edges with one face, in 1 hole")
    g = np.arange(540).reshape(-1, 3)
    cases["soup"] = (v[f].reshape(-1, 3), g, "open-boundary", 540, 0, "448 vertices lie on another")
    g = f.copy()
    g[[6, 90]] = g[[6, 90]][:, ::-1]
    cases["turned faces"] = (v, g, "inconsistent-orientation", 6, None, "6 edges between faces that turn opposite ways")
    w, g = joined((v, f), (v * 0.5 + 5, f))
    cases["two"] = (w, g, "several-components", 2, 180, "180 of 360 faces, first face of another")
    cases["torus"] = (*torus(), "genus", 1, None, "genus 1, not 0: 1 handle")
    cases["two tori"] = (*joined(torus(), torus()), "several-components", 2, 216, "2 components")
    cases["inward"] = (v, f[:, ::-1], "inward-orientation", 180, 0, "all 180 faces are clockwise")
    # The projective plane with the fewest vertices, six: half of an icosahedron.
    plane = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 1]]
    plane += [[1, 2, 4], [2, 3, 5], [3, 4, 1], [4, 5, 2], [5, 1, 3]]
    cases["one-sided"] = (v[:6] + np.arange(6)[:, None] ** 2, np.array(plane), "not-orientable", 1, None, "one-sided")
    return cases


@pytest.mark.parametrize("name", spoiled())
def test_defect_is_named_counted_placed_and_has_a_remedy(name):
    vertices, faces, kind, count, where, words = spoiled()[name]
    first = check(vertices, faces)[0]
    assert (first.kind, first.count) == (kind, count), str(first)
    assert words in str(first)
    assert first.where == where or where is None
    assert "\n" not in str(first) and "; " in str(first)
    with pytest.raises(OmtwarpError) as caught:
        require_valid(vertices, faces, "it.ply")
    assert str(caught.value).startswith("it.ply: " + str(first))


def test_genus_is_counted_and_its_loop_does_not_part_the_surface():
    """A double torus, glued from two tori along a removed face, has genus 2."""
    (v, f), (w, g) = torus(), torus()
    w = w + [6.0, 0, 0]
    a, b = f[0], (g[0] + len(v))[::-1]
    faces = np.concatenate([f[1:], g[1:] + len(v)])
    for old, new in zip(b, a, strict=True):
        faces[faces == old] = new
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.concatenate([v, w])[used]
    (defect,) = check(vertices, faces.reshape(-1, 3))
    assert (defect.kind, defect.count) == ("genus", 2)
    topology = Topology(faces.reshape(-1, 3).astype(np.int64), len(vertices))
    assert topology.handle_edge.tolist() in topology.edges.tolist()


def test_other_kinds_of_defect_are_named_in_brackets():
    v, f = ball()
    with pytest.raises(OmtwarpError, match=r"unused.* \(also: open-boundary\)$|vertex 92; .*\(also: open-boundary\)$"):
        require_valid(np.concatenate([v, v[:1]]), f[1:])


@given(
    scale=st.sampled_from([1e-300, 1e-30, 1e-8, 1.0, 1e8, 1e30, 1e300]),
    shift=st.tuples(*[st.floats(-50, 50)] * 3),
    seed=st.integers(0, 20),
)
def test_a_sound_mesh_is_sound_at_any_scale_and_place(scale, shift, seed):
    blob = shapes.blob(seed=seed, sphere=320)
    vertices = (blob.vertices + np.array(shift)) * scale
    points, faces = require_valid(vertices, blob.faces)
    np.testing.assert_array_equal(points, vertices)
    np.testing.assert_array_equal(faces, blob.faces)
    assert faces.dtype == np.int32 and points.dtype == np.float64


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_a_surface_at_an_extreme_scale_is_scaled_like_any_other(scale):
    blob = shapes.blob(sphere=320)
    scaled = Surface(blob.vertices * scale, blob.faces).scaled_vertices
    np.testing.assert_allclose(scaled, blob.scaled_vertices, rtol=1e-12)


@given(st.integers(0, 1000))
def test_turning_any_faces_is_found_and_undone(seed):
    """The faces that `orientation` names, turned, leave a consistent mesh."""
    v, f = ball()
    turned = np.random.default_rng(seed).random(len(f)) < 0.3
    f[turned] = f[turned][:, ::-1]
    topology = Topology(f, len(v))
    orientable, wrong = topology.orientation
    assert orientable
    f[wrong] = f[wrong][:, ::-1]
    assert not Topology(f, len(v)).clashing_edges.any()


def test_a_mesh_is_checked_and_repaired_in_every_form(tmp_path):
    ball = shapes.icosphere(2)
    write_mesh(tmp_path / "ball.ply", ball.vertices, ball.faces)
    arrays = ball.vertices, ball.faces
    for mesh in (ball, arrays, omtwarp.read_mesh(tmp_path / "ball.ply"), trimesh.Trimesh(*arrays)):
        assert omtwarp.check(mesh) == omtwarp.check(*arrays) == []
        assert omtwarp.repair(mesh).actions == []
    for wrong in (None, "ball", [1.0, 2.0, 3.0]):
        assert [defect.kind for defect in omtwarp.check(wrong)] == ["not-a-triangle-mesh"]
        with pytest.raises(OmtwarpError, match=r"expected a trimesh\.Trimesh or \(vertices, faces\)"):
            omtwarp.repair(wrong)


@pytest.mark.parametrize("inside", [False, True], ids=["by one edge", "by two edges"])
def test_the_boundary_of_a_face_that_hangs_is_neither_a_hole_nor_a_loop(inside):
    """A face at two neighbours of a vertex and a new vertex, or at that vertex and two of its neighbours."""
    v, f = ball()
    middle = int(f[0, 0])
    ring = np.setdiff1d(f[(f == middle).any(axis=1)], [middle])
    first = int(ring[0])
    beside = {int(k) for face in f if first in face for k in face}
    if inside:
        far = next(int(k) for k in ring if int(k) not in beside)
        face, path = [first, middle, far], f"a path of 1 edge at vertex {min(first, far)};"
    else:
        face, path = [middle, first, len(v)], f"a path of 2 edges at vertex {min(middle, first)};"
        v = np.concatenate([v, [[2.0, 2.0, 2.0]]])
    faces = np.concatenate([f, [face]])
    (defect,) = (d for d in check(v, faces) if d.kind == "open-boundary")
    count = "1 edge" if inside else "2 edges"
    assert f"open boundary: {count} with one face, in 1 line, {path} drop the extra faces" in str(defect)
    assert not check(omtwarp.repair(v, faces))
