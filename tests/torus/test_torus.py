"""Surfaces of genus 1 on flat tori: conformal lattices, transport in closed form, exact orientation, files."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from texture_truths import jumps_across_edges

import omtwarp
from omtwarp.geometry.intrinsic import delaunay_edges
from omtwarp.geometry.operators import corner_cotangents
from omtwarp.maps.torus_map import ring_torus as on_ring_torus
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.metrics.optimality import torus_optimality
from omtwarp.optimal import exact as exact_areas
from omtwarp.options import MapOptions
from omtwarp.texturing.textured import torus_pattern
from omtwarp.torus import mapping as torus_mapping, transport as torus_transport
from omtwarp.torus.harmonic import FlatTorus, conformal_torus, quantised
from omtwarp.torus.mapping import map_to_torus
from omtwarp.torus.transport import TorusMaps

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from random_handles import sides, surface_with_handles


def grid_torus(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A periodic grid, its triangles cut along alternating diagonals: places [V, 2] in [0, 1)², faces, wraps."""
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    places = np.stack([i.ravel() / columns, j.ravel() / rows], axis=1)
    faces, wraps = [], []
    for a, b in zip(i.ravel().tolist(), j.ravel().tolist(), strict=True):
        square = [(a, b), (a + 1, b), (a + 1, b + 1), (a, b + 1)]
        halves = ((0, 1, 2), (0, 2, 3)) if (a + b) % 2 else ((0, 1, 3), (1, 2, 3))
        for half in halves:
            corner = [square[k] for k in half]
            faces.append([(x % columns) * rows + y % rows for x, y in corner])
            wraps.append([(x // columns, y // rows) for x, y in corner])
    return places, np.array(faces), np.array(wraps)


def ring_torus(large: float, columns: int, rows: int) -> Surface:
    """A ring torus of tube radius 1, a grid in its two angles."""
    places, faces, _ = grid_torus(columns, rows)
    turn, tilt = 2.0 * np.pi * places.T
    reach = large + np.cos(tilt)
    return Surface(np.stack([reach * np.cos(turn), reach * np.sin(turn), np.sin(tilt)], axis=1), faces)


def test_lattice_of_a_ring_torus_is_the_one_it_is_conformal_to():
    """The ring torus of radii R and 1 is conformal to the rectangle of sides 1 and sqrt(R² - 1)."""
    torus = conformal_torus(ring_torus(2.0, 60, 36))
    one, two = torus.lattice
    assert np.linalg.norm(two) / np.linalg.norm(one) == pytest.approx(np.sqrt(3.0), rel=0.01)
    assert abs(one @ two) < 0.02 * np.linalg.norm(one) * np.linalg.norm(two)
    assert np.linalg.det(torus.lattice) == pytest.approx(SPHERE_AREA)


def test_transport_of_a_density_of_one_coordinate_is_monotone_rearrangement():
    """Masses that depend on x alone move along x to where as much mass lies before them, to second order."""
    errors, costs = [], []
    side, wave = np.sqrt(SPHERE_AREA), 2.0 * np.pi
    for columns in (10, 20, 40):
        places, faces, wraps = grid_torus(columns, 6)
        # The surface says which triangles there are: masses are given, and shapes are of right angles.
        flat = FlatTorus(quantised(places), wraps, side * np.eye(2))
        middle = flat.corners(faces)[..., 0].mean(axis=1)
        density = 1.0 + 0.5 * np.sin(wave * middle)
        moved, _ = TorusMaps(Surface(ring_torus(3.0, columns, 6).vertices, faces, density), flat).optimal()
        assert moved.converged
        apart = moved.points / side - places
        assert np.ptp(apart[:, 1]) < 5e-6
        wrong = apart[:, 0] + 0.5 / wave * np.cos(wave * places[:, 0])
        errors.append(float(np.std(wrong)))
        costs.append(moved.history[-1]["cost"] / SPHERE_AREA**2 - 0.125 / wave**2)
    assert errors[-1] < 2e-4 and all(one / other > 3.7 for one, other in pairwise(errors)), errors
    assert abs(costs[-1]) < 1e-5 and all(one / other > 3.7 for one, other in pairwise(costs)), costs


@pytest.mark.parametrize("surface", [ring_torus(2.0, 36, 20), shapes.rings(1, cell=0.3)], ids=["ring", "implicit"])
def test_map_is_one_to_one_keeps_areas_and_closes_up(surface, tmp_path):
    result = omtwarp.map_surface(surface)
    assert result.domain == "torus" and result.bijective and result.certificate.flips == 0
    measured = result.distortion()
    assert measured.area["surface"] < 2.01 and measured.degree == pytest.approx(1.0)
    corner = result.corners @ result.lattice
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    areas = 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    own = triangle_areas(surface.vertices, surface.faces)
    assert areas.min() > 0.0 and areas.sum() == pytest.approx(own.sum())
    around = [np.bincount(surface.faces.ravel(), np.repeat(values, 3)) for values in (areas, own)]
    assert np.abs(around[0] / around[1] - 1.0).max() < 1e-4
    # Neighbouring triangles differ along their edge by whole numbers, the same at both ends: a texture repeats there.
    steps = result.corners[:, [1, 2, 0]] - result.corners
    ends = np.stack([surface.faces, surface.faces[:, [1, 2, 0]]], axis=2)
    forward = {tuple(pair): step for pair, step in zip(ends.reshape(-1, 2).tolist(), steps.reshape(-1, 2), strict=True)}
    assert all(np.array_equal(step, -forward[b, a]) for (a, b), step in forward.items())
    result.save(tmp_path / "torus.npz")
    again = omtwarp.MapResult.load(tmp_path / "torus.npz")
    assert np.array_equal(again.corners, result.corners) and np.array_equal(again.lattice, result.lattice)
    textured = omtwarp.texture(result, pattern="checker", size=64)
    assert np.array_equal(textured.vertices, surface.vertices) and np.array_equal(textured.faces, surface.faces)
    # Up to whole pictures, the corners at a vertex have one place in the picture.
    assert np.array_equal(textured.uv % 1.0, (result.coordinates % 1.0)[surface.faces])
    assert np.allclose(textured.trimesh().area, own.sum())
    u, v = np.meshgrid(2.0 * np.pi * (np.arange(64) + 0.5) / 64, 2.0 * np.pi * (np.arange(64) + 0.5) / 64)
    picture = np.rint(127.5 + 120.0 * np.stack([np.sin(u), np.cos(v), np.sin(u + v)], axis=-1)).astype(np.uint8)
    _, jumps = jumps_across_edges(omtwarp.texture(result, picture))
    assert len(jumps) == 3 * surface.face_count // 2 and jumps.max() < 1e-9


def test_a_flip_is_seen_in_the_universal_cover():
    result = omtwarp.map_surface(ring_torus(2.0, 12, 8))
    moved = result.coordinates.copy()
    moved[5] += [0.4, 0.3]
    broken = replace(result, coordinates=moved)
    assert broken.certificate.flips > 0 and not broken.bijective


def test_other_surfaces_do_not_go_to_a_torus(tmp_path):
    with pytest.raises(omtwarp.OmtwarpError, match="genus 1"):
        omtwarp.map_surface(shapes.icosphere(4), domain="torus")
    np.savez(tmp_path / "not.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(omtwarp.OmtwarpError, match="no 'faces'"):
        omtwarp.MapResult.load(tmp_path / "not.npz")


def test_circles_are_round_on_a_slanted_torus_and_close_up():
    """The pattern covers the share that it promises, and each circle's second moments are those of a disc."""
    lattice = np.array([[2.0, 0.0], [0.7, 5.0]])
    picture = torus_pattern("circles", lattice, 240)
    height, width = picture.shape[:2]
    assert height / width == pytest.approx(np.linalg.norm(lattice[1]) / 2.0, rel=0.01)
    inside = picture.min(axis=2) < 180
    assert inside.mean() == pytest.approx(0.56, abs=0.02)
    labels, count = ndimage.label(np.tile(inside, (2, 2)))
    whole = [region for region in range(1, count + 1) if not _touches_the_rim(labels == region)]
    assert len(whole) > 100
    for region in whole[::10]:
        rows, columns = np.nonzero(labels == region)
        places = np.stack([columns / width, -rows / height], axis=1) @ lattice
        low, high = np.linalg.eigvalsh(np.cov(places.T))
        assert high / low < 1.1


def _touches_the_rim(region: np.ndarray) -> bool:
    return bool(region[0].any() or region[-1].any() or region[:, 0].any() or region[:, -1].any())


def test_ring_torus_keeps_areas_in_proportion_and_faces_outwards():
    columns, rows = 200, 80
    places, faces, _ = grid_torus(rows, columns)
    lattice = np.array([[2.0, 0.0], [0.3, 5.0]])
    points = on_ring_torus(places, lattice)
    areas = triangle_areas(points, faces)
    assert np.abs(areas / areas.mean() - 1.0).max() < 0.03  # of chords
    corner = points[faces]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6.0
    share = 2.0 / np.linalg.norm(lattice[1])
    assert volume == pytest.approx(2.0 * np.pi**2 * share**2, rel=0.01)


def test_ring_torus_goes_to_its_closed_form():
    """Areas of a ring torus depend on the tube's angle alone: it goes to where as much area lies before it."""
    errors, shapes_of_lattice = [], []
    for rows in (12, 24, 48):
        columns = 3 * rows // 2
        result = omtwarp.map_surface(ring_torus(2.0, columns, rows))
        tilt = 2.0 * np.pi * np.tile(np.arange(rows) / rows, columns)
        goal = (tilt + 0.5 * np.sin(tilt)) / (2.0 * np.pi)
        found = result.coordinates[:, 0]  # the ring is longer than the tube
        turns = [np.exp(2.0j * np.pi * (sign * found - goal)) for sign in (1.0, -1.0)]
        apart = [np.angle(turn / turn.mean()) / (2.0 * np.pi) for turn in turns]
        errors.append(min(float(np.sqrt((each**2).mean())) for each in apart))
        along = np.linalg.norm(result.lattice, axis=1)
        shapes_of_lattice.append(float(along[1] / along[0] - np.sqrt(3.0)))
        measured = result.report["optimality"]
        assert measured["gap"] < 3e-4 and measured["relative_curl"] < 0.02 and measured["wrapped"] == 0
    assert errors[-1] < 3e-4 and all(one / other > 3.7 for one, other in pairwise(errors)), errors
    assert all(one / other > 3.7 for one, other in pairwise(shapes_of_lattice)), shapes_of_lattice


@pytest.mark.parametrize("seed", [35, 39])
def test_a_slender_knot_ends_at_its_optimum(seed):
    """Its embedding is far from the optimum: with constraints at once steps end 0.2 % above the bound."""
    result = omtwarp.map_surface(surface_with_handles(seed, 6000), domain="torus")
    stage = result.report["stages"][-1]
    assert stage["ended"] == "optimal" and result.report["optimality"]["gap"] < 1e-3


@pytest.mark.parametrize("seed", [1, 9])
def test_map_does_not_depend_on_the_loops_that_it_starts_from(seed):
    """Another numbering gives other loops, and the same triangles up to a motion of the torus.

    The first has a long limb that the conformal map shrinks, the second one nearly Delaunay triangles.
    """
    surface = surface_with_handles(seed, 2500)
    rng = np.random.default_rng(4)
    order, faces = rng.permutation(len(surface.vertices)), rng.permutation(len(surface.faces))
    other = Surface(surface.vertices[order], np.argsort(order)[surface.faces[faces]])
    first, again = (map_to_torus(each, MapOptions(optimality=False)) for each in (surface, other))
    assert np.allclose(np.abs(first.lattice), np.abs(again.lattice), rtol=1e-9, atol=1e-9)
    apart = np.abs(sides(first)[faces] - sides(again)).max() / sides(first).mean()
    assert apart < 1e-3
    conformal = [replace(each, coordinates=each.conformal) for each in (first, again)]
    assert np.abs(sides(conformal[0])[faces] - sides(conformal[1])).max() < 1e-7 * sides(first).mean()


def test_intrinsic_delaunay_triangles_close_up_and_store_least_energy():
    """Every flipped edge lowers the Dirichlet energy of functions at vertices: no function has more than before."""
    surface = surface_with_handles(9, 2000)
    edges = delaunay_edges(surface, np.zeros((surface.face_count, 3, 2), dtype=np.int64))
    assert edges.flips > 0
    own = 0.5 * corner_cotangents(surface.scaled_vertices, surface.faces).ravel()[surface.edge_corners].sum(axis=1)
    values = np.random.default_rng(2).normal(size=(surface.vertex_count, 50))
    values[:, :3] = surface.scaled_vertices
    energies = [
        np.einsum("e,ek->k", weights, (values[ends[:, 1]] - values[ends[:, 0]]) ** 2)
        for ends, weights in ((edges.ends, edges.weights), (surface.edges, own))
    ]
    assert (energies[0] <= energies[1] * (1.0 + 1e-12)).all() and (energies[0] < energies[1]).any()
    # Coordinates in space have twice the area as their energy, summed over all three, on the triangles as they are.
    assert energies[1][:3].sum() == pytest.approx(2.0 * SPHERE_AREA)
    assert energies[0][:3].sum() < 2.0 * SPHERE_AREA


def test_bound_sees_a_map_that_is_not_optimal():
    """A shear keeps areas; its curl is a half of its displacement, and the bound lies far below its cost."""
    columns, rows = 24, 24
    places, faces, wraps = grid_torus(columns, rows)
    side = np.sqrt(SPHERE_AREA)
    surface = Surface(ring_torus(3.0, columns, rows).vertices, faces, np.ones(len(faces)))
    x = places * side
    sheared = x + 0.2 * np.stack([np.sin(2.0 * np.pi * places[:, 1]), np.zeros(len(x))], axis=1)
    measured = torus_optimality(surface, x, sheared, wraps * side, side * np.eye(2))
    assert measured.cost == pytest.approx(SPHERE_AREA * 0.02) and measured.lower_bound < 0.1 * measured.cost
    assert measured.relative_curl > 0.99
    moved = x + 0.2 * np.stack([np.sin(2.0 * np.pi * places[:, 0]), np.zeros(len(x))], axis=1)
    gradient = torus_optimality(surface, x, moved, wraps * side, side * np.eye(2))
    assert gradient.gap < 1e-2 and gradient.relative_curl < 1e-3


def hollow_ring() -> Surface:
    """A ring with a deep dent, which the conformal map shrinks to a hundredth: a coarse mug."""

    def value(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        around = np.hypot(x, y)
        cup = np.maximum(np.maximum(around - 0.7, np.abs(z) - 0.7), -np.maximum(around - 0.45, -0.4 - z))
        handle = np.maximum(np.hypot(np.hypot(x - 0.75, z) - 0.42, y) - 0.16, 0.6 - around)
        return -0.06 * np.logaddexp(-cup / 0.06, -handle / 0.06)

    return shapes.implicit_surface(value, [-1, -1, -1], [1.6, 1, 1], cell=0.24)


def test_cost_of_a_mug_lies_between_its_bound_and_that_of_every_plan():
    """The bound holds for the best plan between the points, found independently, and is nearly that plan's cost."""
    ot = pytest.importorskip("ot")
    surface = hollow_ring()
    result = omtwarp.map_surface(surface)
    x, y = result.conformal @ result.lattice, result.coordinates @ result.lattice
    scale = SPHERE_AREA / triangle_areas(surface.vertices, surface.faces).sum()
    apart = y[None] - x[:, None]
    apart -= np.round(apart @ np.linalg.inv(result.lattice)) @ result.lattice
    near = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]) @ result.lattice
    square = np.min([((apart + step) ** 2).sum(axis=2) for step in near], axis=0)
    mass = surface.vertex_areas / SPHERE_AREA
    best = SPHERE_AREA * scale * ot.emd2(mass, mass, square, numItermax=10_000_000)
    measured = result.report["optimality"]
    assert measured["lower_bound"] <= best * (1.0 + 1e-9) and best <= measured["cost"] * (1.0 + 1e-9)
    assert measured["gap"] < 5e-3 and measured["cost"] < 1.003 * best
    assert result.bijective and result.distortion().area["surface"] < 2.02


def test_exact_and_refined_maps():
    surface = shapes.rings(1, cell=0.35)
    plain = omtwarp.map_surface(surface)
    exact = omtwarp.map_surface(surface, exact=True)
    assert exact.bijective and len(exact.faces) == 4 * surface.face_count
    corner = exact.corners @ exact.lattice
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    areas = 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    own = triangle_areas(surface.vertices, surface.faces)
    assert np.abs(np.bincount(exact.face_origin, areas) / own - 1.0).max() < 2e-6
    refined = omtwarp.map_surface(surface, refine="balanced")
    assert refined.bijective
    assert refined.distortion().angle["surface"] < plain.distortion().angle["surface"]
    measured = exact.report["optimality"]  # of the parts' map, which areas of triangles leave less free
    assert measured["gap"] < 5e-3 and measured["cost"] == pytest.approx(plain.report["optimality"]["cost"], rel=0.2)
    assert refined.report["optimality"]["relative_curl"] > plain.report["optimality"]["relative_curl"]
    matched = omtwarp.map_surface(surface, refine="match:2.05")
    assert matched.distortion().area["surface"] == pytest.approx(2.05, abs=5e-3)
    with pytest.warns(omtwarp.OmtwarpWarning, match="no map with the area distortion 50 was found") as caught:
        far = omtwarp.map_surface(surface, refine="match:50", optimality=False)
    assert f"this one has {far.distortion().area['surface']:.6g}"[:-1] in str(caught[0].message)
    with pytest.raises(omtwarp.OmtwarpError, match="no map with the area distortion 50"):
        omtwarp.map_surface(surface, refine="match:50", optimality=False, strict=True)
    with pytest.raises(omtwarp.OmtwarpError, match="exact areas"):
        omtwarp.map_surface(surface, exact=True, refine="area")
    with pytest.raises(omtwarp.OmtwarpError, match="has none"):
        omtwarp.map_surface(surface, until="conformal")


def test_what_a_map_to_a_torus_does_not_keep_is_told(monkeypatch):
    ring = shapes.rings(1, cell=0.4)
    assert omtwarp.map_surface(ring).report["warnings"] == []
    monkeypatch.setattr(torus_mapping, "WRONG_AREA", -1.0)
    with pytest.warns(omtwarp.OmtwarpWarning, match="areas around vertices are kept to 0.0% at worst: remesh"):
        assert [told["kind"] for told in omtwarp.map_surface(ring).report["warnings"]] == ["vertex-areas"]
    monkeypatch.setattr(torus_transport, "GAIN", 0.0)
    with pytest.warns(omtwarp.OmtwarpWarning, match="the stage omt did not converge"):
        told = omtwarp.map_surface(ring).report["warnings"]
    assert [one["kind"] for one in told] == ["not-converged", "vertex-areas"]
    monkeypatch.setattr(exact_areas, "EXACT", 0.0)
    with pytest.raises(omtwarp.OmtwarpError, match="exact areas were not reached"):
        omtwarp.map_surface(ring, exact=True)


def test_intrinsic_delaunay_weights_of_a_twisted_grid():
    """Edges are flipped until no weight is negative, and their steps say where they lead to."""
    places, faces, wraps = grid_torus(20, 12)
    turn, tilt = 2.0 * np.pi * places[:, 0], 2.0 * np.pi * (places[:, 1] + 3.0 * places[:, 0])
    reach = 2.0 + np.cos(tilt)
    surface = Surface(np.stack([reach * np.cos(turn), reach * np.sin(turn), np.sin(tilt)], axis=1), faces)
    edges = delaunay_edges(surface, wraps)
    assert len(edges.ends) == len(surface.edges) and edges.flips > 0 and edges.weights.min() > 0.0
    along = places[edges.ends[:, 1]] - places[edges.ends[:, 0]] + edges.steps
    # Without the twist, edges are short: none leads around the tube or the ring.
    assert np.abs(along[:, 0]).max() < 0.2 and np.abs(along[:, 1] + 3.0 * along[:, 0]).max() < 0.3


def test_a_warning_names_the_line_that_asked_for_the_map():
    ring = omtwarp.shapes.rings(1, cell=0.4)
    with pytest.warns(omtwarp.OmtwarpWarning, match="no map with the area distortion") as caught:
        omtwarp.map_surface(ring, domain="torus", refine="match:5")
    assert [warning.filename for warning in caught] == [__file__]
