"""Edges that are split because triangles beside them have no room."""

import numpy as np
import pytest
from sphere_truths import SHARED

import omtwarp
from omtwarp import pipeline
from omtwarp.flips.rings import is_bijective
from omtwarp.mesh import shapes
from omtwarp.mesh.arrays import edge_keys
from omtwarp.mesh.names import InputNames
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.open_surfaces.hemisphere import is_symmetric
from omtwarp.spheres import triangle_solid_angles
from omtwarp.topology import long_edges
from omtwarp.topology.boundary import boundary_loops
from omtwarp.topology.doubling import double, split_at
from omtwarp.topology.kind import parts_of
from omtwarp.topology.long_edges import split_long_edges_of_double


def largest_part_above(whole, share):
    """The largest piece of a surface above a share of its longest axis."""
    level = whole.vertices - whole.vertices.min(axis=0)
    level = level[:, np.argmax(level.max(axis=0))]
    above = (level / level.max() > share)[whole.faces].all(axis=1)
    kept = omtwarp.repair(whole.vertices, whole.faces[above], whole=False)
    return max(parts_of(kept.vertices, kept.faces), key=lambda piece: len(piece.faces))


@pytest.fixture(scope="module")
def limbs():
    """Half of a ball with long thin limbs and few vertices around each."""
    part = largest_part_above(shapes.limbs(length=14.0, sharpness=18.0, sphere=980), 0.25)
    return part.vertices, part.faces


def sides(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def test_edges_are_split_at_their_midpoints():
    ball = shapes.icosphere(3)
    chosen = np.sort(ball.edges[::7].astype(np.int64), axis=1)
    split = split_at(ball.vertices, ball.faces, chosen)
    assert len(split.vertices) == ball.vertex_count + len(chosen)
    assert np.allclose(split.vertices[ball.vertex_count :], ball.vertices[chosen].mean(axis=1))
    parts = np.bincount(split.face_origin, triangle_areas(split.vertices, split.faces))
    assert np.allclose(parts, triangle_areas(ball.vertices, ball.faces))
    count = len(split.vertices)
    left = edge_keys(sides(split.faces), count)
    assert not np.isin(edge_keys(chosen, count), left).any()
    assert len(np.unique(left)) == 3 * len(split.faces) // 2  # closed: every edge twice
    same = split_at(ball.vertices, ball.faces, np.zeros((0, 2), dtype=np.int64))
    assert np.array_equal(same.faces, ball.faces)


@pytest.mark.parametrize("weighted", [False, True])
def test_double_is_split_on_both_sides_alike(monkeypatch, weighted):
    ball = shapes.icosphere(5)
    kept = ball.faces[(ball.vertices[ball.faces, 2] > -1e-9).all(axis=1)]
    used, faces = np.unique(kept, return_inverse=True)
    whole = double(ball.vertices[used], faces.reshape(-1, 3))
    points = whole.vertices.copy()
    points[whole.on_boundary, 2] = 0.0
    points /= np.linalg.norm(points, axis=1)[:, None]
    points[whole.copied] = points[whole.mirror[whole.copied]] * [1.0, 1.0, -1.0]
    areas = np.tile(np.linspace(1.0, 3.0, len(kept)), 2) if weighted else None
    surface = Surface(whole.vertices, whole.faces, areas)
    surface.names = InputNames(np.arange(len(whole.mirror)), np.arange(len(whole.faces)))
    assert is_symmetric(whole, points) and split_long_edges_of_double(whole, surface, points) is None
    lengths = np.linalg.norm(points[surface.edges[:, 0]] - points[surface.edges[:, 1]], axis=1)
    monkeypatch.setattr(long_edges, "LONG", float(np.median(lengths)))
    monkeypatch.setattr(long_edges, "LONG_SIDES", 0.0)
    split = split_long_edges_of_double(whole, surface, points)
    assert split is not None and split.surface.weighted == weighted
    added = split.vertex_origin < 0
    assert 0 < added.sum() < len(surface.edges)
    assert np.allclose(split.surface.vertices[added], whole.vertices[split.ends[added]].mean(axis=1))
    assert np.array_equal(split.surface.vertices[~added], whole.vertices[split.vertex_origin[~added]])
    moved = split.on_sphere(points)
    assert is_symmetric(split.double, moved) and is_bijective(moved, split.surface.faces)
    assert np.array_equal(moved[~added], points[split.vertex_origin[~added]])
    # The parts of a triangle have its measure in all, and its name.
    assert np.allclose(np.bincount(split.face_origin, split.surface.face_areas), surface.face_areas)
    assert np.array_equal(split.surface.names.faces, split.face_origin)
    assert np.array_equal(split.surface.names.vertices, split.vertex_origin)
    values = np.arange(len(points), dtype=np.float64)
    assert np.allclose(split.interpolated(values), values[split.ends].mean(axis=1))


@pytest.mark.parametrize("domain", ["hemisphere", "disk", "cap"])
@pytest.mark.parametrize("weighted", [False, True])
def test_result_says_where_edges_were_split(limbs, domain, weighted):
    """Where limbs are few vertices around, areas are kept with a few more, which the result names."""
    vertices, faces = limbs
    weights = np.linspace(1.0, 1.5, len(faces)) if weighted else None
    with pytest.warns(omtwarp.OmtwarpWarning):
        found = omtwarp.map_surface((vertices, faces), domain=domain, weights=weights, device="cpu")
    assert found.certificate.bijective and len(found.split_edges) > 0
    added = found.vertex_origin < 0
    assert added.sum() == len(found.split_edges) == found.report["surface"]["split_edges"]
    assert np.array_equal(found.vertices[~added], vertices[found.vertex_origin[~added]])
    assert np.allclose(found.vertices[added], found.vertices[found.split_edges].mean(axis=1))
    own = triangle_areas(vertices, faces)
    parts = np.bincount(found.face_origin, triangle_areas(found.vertices, found.faces), len(faces))
    assert np.allclose(parts, own, rtol=1e-9)
    # Filled loops go along the surface's boundary, with the new vertices on them.
    rims = boundary_loops(found.faces, len(found.vertices))
    at_rim = edge_keys(np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in rims]), len(added))
    begun = 0
    for end in found.loop_ends:
        loop = found.loops[begun:end]
        assert np.isin(edge_keys(np.stack([loop, np.roll(loop, -1)], axis=1), len(added)), at_rim).all()
        begun = end
    if weighted:
        shares = np.bincount(found.face_origin, found.measure, len(faces))
        assert np.allclose(shares / shares.sum(), weights * own / (weights * own).sum())
    if domain == "hemisphere":
        assert min(np.abs(found.sphere[rim, 2]).max() for rim in rims) == 0.0
        wanted = own if weights is None else weights * own
        there = np.bincount(found.face_origin, triangle_areas(found.sphere, found.faces), len(faces))
        ratio = there / there.sum() / (wanted / wanted.sum())
        assert np.average(ratio + 1.0 / ratio, weights=wanted) < 2.01


def test_nothing_is_split_where_areas_are_exact(limbs):
    """All edges are split once there; the result is that of the quartered input."""
    vertices, faces = limbs
    found = omtwarp.map_surface((vertices, faces), domain="hemisphere", exact=True, optimality=False, device="cpu")
    assert len(found.faces) == 4 * len(faces) and found.certificate.bijective


def test_split_halves_do_not_depend_on_how_the_input_is_numbered(limbs):
    vertices, faces = limbs
    rng = np.random.default_rng(2)
    order, rows = rng.permutation(len(vertices)), rng.permutation(len(faces))
    corners = np.argsort(order)[faces[rows]]
    with pytest.warns(omtwarp.OmtwarpWarning):
        found = omtwarp.map_surface((vertices, faces), domain="hemisphere", optimality=False, device="cpu")
        other = omtwarp.map_surface((vertices[order], corners), domain="hemisphere", optimality=False, device="cpu")
    assert np.array_equal(other.sphere[: len(vertices)], found.sphere[: len(vertices)][order])
    assert len(other.split_edges) == len(found.split_edges) > 0


@pytest.mark.parametrize(("name", "split", "gap"), [("box_11k", True, None), ("octopus_33k", False, 0.011)])
def test_halves_of_a_drawn_part_and_of_long_limbs(name, split, gap):
    """A box with needles along the cut comes to 2.001 to 2.004, an octopus to 2.0056 at a gap of 0.9 %."""
    path = SHARED / "data" / f"{name}.ply"
    if not path.exists():
        pytest.skip("the evaluation meshes are not beside this checkout (../shared/data)")
    part = largest_part_above(omtwarp.read_mesh(path), 0.5)
    with pytest.warns(omtwarp.OmtwarpWarning, match="did not converge"):
        found = omtwarp.map_surface(part, domain="hemisphere", device="cpu")
    measured = found.distortion()
    assert found.certificate.bijective and measured.flips == 0 and measured.area["surface"] < 2.015
    rims = boundary_loops(found.faces, len(found.vertices))  # of holes, and one on the equator
    assert min(np.abs(found.sphere[rim, 2]).max() for rim in rims) == 0.0
    assert (len(found.split_edges) > 100) == split
    assert gap is None or found.report["optimality"]["gap"] < gap


@pytest.fixture
def drawn(monkeypatch):
    """A smooth shape that is taken for a drawn part, with edges above 0.1 radians taken for long ones."""
    monkeypatch.setattr(pipeline._Run, "rough", property(lambda run: True))
    monkeypatch.setattr(pipeline, "ROUGH_LARGEST_AREA", 2.0)
    monkeypatch.setattr(long_edges, "LONG", 0.1)
    monkeypatch.setattr(long_edges, "LONG_SIDES", 0.0)
    return shapes.blob(seed=3, sphere=720)


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
@pytest.mark.parametrize("weighted", [False, True])
def test_closed_part_has_its_long_edges_split(drawn, weighted):
    """The result holds the input's vertices first, whole triangles as they were, and parts of the others."""
    weights = np.linspace(1.0, 1.5, drawn.face_count) if weighted else None
    found = omtwarp.map_to_sphere(drawn, weights=weights, device="cpu")
    count, added = drawn.vertex_count, len(found.vertices) - drawn.vertex_count
    assert added > 0 and found.certificate.bijective
    assert found.report["stages"][2]["split_edges"] == added
    assert np.array_equal(found.vertices[:count], drawn.vertices)
    assert np.array_equal(found.vertex_origin, np.r_[np.arange(count), np.full(added, -1)])
    parts = np.bincount(found.face_origin, triangle_areas(found.vertices, found.faces))
    assert np.allclose(parts, triangle_areas(drawn.vertices, drawn.faces))
    whole = np.bincount(found.face_origin)[found.face_origin] == 1
    assert np.array_equal(found.faces[whole], drawn.faces[found.face_origin[whole]]) and not whole.all()
    assert (np.diff(found.face_origin) >= 0).all()
    if weighted:
        shares = np.bincount(found.face_origin, found.measure)
        wanted = weights * triangle_areas(drawn.vertices, drawn.faces)
        assert np.allclose(shares / shares.sum(), wanted / wanted.sum())
    worst = found.certificate.smallest_face
    solid = triangle_solid_angles(*np.swapaxes(found.sphere[found.faces], 0, 1))
    assert solid[worst] == pytest.approx(solid.min(), rel=1e-6)


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_split_closed_part_does_not_depend_on_how_the_input_is_numbered(drawn):
    rng = np.random.default_rng(5)
    order, rows = rng.permutation(drawn.vertex_count), rng.permutation(drawn.face_count)
    other = Surface(drawn.vertices[order], np.roll(np.argsort(order)[drawn.faces[rows]], 1, axis=1))
    found, again = (omtwarp.map_to_sphere(each, optimality=False, device="cpu") for each in (drawn, other))
    count = drawn.vertex_count
    assert np.array_equal(again.sphere[:count], found.sphere[:count][order])
    assert np.array_equal(again.sphere[count:], found.sphere[count:])


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_refinement_goes_on_from_a_split_part(drawn, tmp_path):
    found = omtwarp.map_to_sphere(drawn, refine="area", device="cpu")
    assert len(found.vertices) > drawn.vertex_count and found.certificate.bijective
    found.save(tmp_path / "map.npz")
    again = omtwarp.MapResult.load(tmp_path / "map.npz")
    assert np.array_equal(again.face_origin, found.face_origin) and np.array_equal(again.sphere, found.sphere)


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
@pytest.mark.parametrize("options", [{"keep_edges": True}, {"exact": True}])
def test_no_long_edges_are_split_where_they_are_kept(drawn, options):
    found = omtwarp.map_to_sphere(drawn, optimality=False, device="cpu", **options)
    parts = 4 if "exact" in options else 1
    assert len(found.faces) == parts * drawn.face_count
    assert found.report.get("keep_edges", False) == options.get("keep_edges", False)


def test_bracket_keeps_areas_with_its_long_edges_split():
    """On its own vertices the least area distortion found is 2.025, with areas around vertices free."""
    path = SHARED / "data" / "bracket_4k.ply"
    if not path.exists():
        pytest.skip("the evaluation meshes are not beside this checkout (../shared/data)")
    mesh = omtwarp.read_mesh(path)
    with pytest.warns(omtwarp.OmtwarpWarning, match="did not converge"):
        found = omtwarp.map_to_sphere(mesh, device="cpu")
    measured = found.distortion()
    assert found.certificate.bijective and measured.flips == 0 and measured.area["surface"] < 2.02
    assert 0 < (found.vertex_origin < 0).sum() < 400
