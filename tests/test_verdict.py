"""Warnings about maps, ``strict``, and good maps without warnings."""

from __future__ import annotations

import json
import re
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.mapping import pipeline
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mapping.verdict import accepted, elongation, foretell, judge
from omtwarp.maps.result import StageReport
from omtwarp.mesh.shapes import blob, flip_edges, icosphere, tube
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.options import MapOptions

sys.path.insert(0, str(Path(__file__).parent / "hostile"))
from hostile_meshes import creature, large_face, needle_pair, prism


def kinds(result):
    return [finding["kind"] for finding in result.report["warnings"]]


def test_a_face_with_forty_percent_of_the_area_is_named_with_its_place():
    vertices, faces = large_face(0.4, 3)
    with pytest.warns(OmtwarpWarning, match=r"area distortion \d\.\d+.*face 0 at \(.*split large triangles") as caught:
        result = map_to_sphere((vertices, faces), device="cpu")
    assert kinds(result)[0] == "area-distortion"
    assert [str(each.message) for each in caught] == [finding["text"] for finding in result.report["warnings"]]
    assert all("\n" not in finding["text"] for finding in result.report["warnings"])
    json.dumps(result.report["warnings"])
    areas = triangle_areas(vertices, faces)
    assert result.report["warnings"][0]["where"] == np.argmax(areas) == 0
    with pytest.raises(OmtwarpError, match=r"strict=True: area distortion"):
        map_to_sphere((vertices, faces), device="cpu", strict=True)


def test_the_areas_around_vertices_come_first_with_how_far_they_are_off():
    """They are what the map promises; the line begins with the largest error, which is measured here anew."""
    sphere = icosphere(3)
    points = sphere.vertices + [0.1, 0.2, 0.4]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    around, triangles = judge(sphere, points, [], MapOptions())
    assert (around.kind, triangles.kind) == ("vertex-areas", "area-distortion")
    a, b, c = (points[sphere.faces[:, k]] for k in range(3))
    cosines = 1.0 + sum((one * other).sum(axis=1) for one, other in ((a, b), (b, c), (c, a)))
    image = 2.0 * np.arctan2((a * np.cross(b, c)).sum(axis=1), cosines)  # solid angles
    goal = triangle_areas(sphere.vertices, sphere.faces)
    per_vertex = [np.bincount(np.ravel(sphere.faces), np.repeat(each / each.sum(), 3)) for each in (image, goal)]
    error = np.abs(per_vertex[0] / per_vertex[1] - 1.0)
    assert around.where == np.argmax(error)
    words = (
        r"areas around vertices are off by up to (\d+)%, the most at vertex \d+ at .*, and by more than 10% at (\d+)"
    )
    off, count = re.match(words, str(around)).groups()
    assert error.max() == pytest.approx(int(off) / 100, abs=0.006) and int(count) == (error > 0.1).sum()
    with pytest.raises(OmtwarpError, match=r"^not accepted with strict=True: areas around vertices are off by"):
        accepted([around, triangles], strict=True)
    assert accepted([around, triangles], strict=False) == [around.to_dict(), triangles.to_dict()]


def test_a_minimum_far_above_the_bound_is_not_called_optimal(monkeypatch):
    """What converged is not optimal where gap and curl are above their limits: that is said."""
    surface = blob(seed=3, amplitude=0.4, sphere=320)
    assert map_to_sphere(surface, device="cpu").report["stages"][1]["converged"]
    monkeypatch.setattr(pipeline, "FAR_GAP", 0.0)
    monkeypatch.setattr(pipeline, "FAR_CURL", 0.0)
    with pytest.warns(OmtwarpWarning, match=r"omt did not converge: a minimum with the shape term, [\d.e-]+ % above"):
        result = map_to_sphere(surface, device="cpu")
    stage = next(stage for stage in result.report["stages"] if stage["name"] == "omt")
    assert not stage["converged"] and "above the bound" in stage["ended"]
    monkeypatch.setattr(pipeline, "NO_BOUND", 0.0)
    with pytest.warns(OmtwarpWarning, match="a minimum with the shape term, without a bound on its cost"):
        assert map_to_sphere(surface, device="cpu").report["optimality"]["gap"] is None


def test_a_plate_as_cad_programs_write_it():
    with pytest.warns(OmtwarpWarning, match="long triangles"):
        result = map_to_sphere(prism(40, 0.02, "fan"), device="cpu")
    assert "area-distortion" in kinds(result)


@pytest.mark.parametrize("ratio", [1e2, 1e8])
def test_a_pair_of_needles_is_mapped_in_silence(ratio):
    """A pair of needles whose map is good gives no warning, since warnings depend on the map."""
    vertices, faces = needle_pair(ratio)
    assert elongation(Surface(vertices, faces)).max() > 0.9 * ratio
    with warnings.catch_warnings():
        warnings.simplefilter("error", OmtwarpWarning)
        assert kinds(map_to_sphere((vertices, faces), device="cpu", strict=True)) == []


def test_good_maps_are_silent():
    for surface in (icosphere(3), blob(seed=3, sphere=320), tube(4.0, face_count=600)):
        assert foretell(surface) == []
        with warnings.catch_warnings():
            warnings.simplefilter("error", OmtwarpWarning)
            assert kinds(map_to_sphere(surface, device="cpu", strict=True, optimality=False)) == []


def test_maps_that_do_not_promise_areas_are_silent():
    vertices, faces = large_face(0.4, 3)
    for options in ({"until": "moser"}, {"method": "haker"}, {"method": "tutte"}):
        assert kinds(map_to_sphere((vertices, faces), device="cpu", strict=True, **options)) == []


def test_the_worst_vertex_is_the_one_that_was_moved():
    sphere = icosphere(4)
    points = sphere.vertices.copy()
    moved = 17
    neighbour = sphere.edges[(sphere.edges == moved).any(axis=1)][0].sum() - moved
    points[moved] = points[moved] + 0.45 * (points[neighbour] - points[moved])
    points[moved] /= np.linalg.norm(points[moved])
    goal = Surface(sphere.vertices, sphere.faces)
    assert judge(goal, sphere.vertices, [], MapOptions()) == []
    found = {finding.kind: finding for finding in judge(goal, points, [], MapOptions())}
    assert "area-distortion" not in found  # one vertex of 160
    near = {moved, *sphere.edges[(sphere.edges == moved).any(axis=1)].ravel().tolist()}
    assert found["vertex-areas"].where in near
    assert "at (" in str(found["vertex-areas"])


def test_a_stage_that_did_not_converge_is_said():
    sphere = icosphere(3)
    measured = {"flips": 0, "degree": 1.0, "finite": True, "area": {}, "angle": {}}
    details = {"converged": False, "ended": "no step lowers the cost", "gave_up": "3 flipped triangles were held back"}
    record: StageReport = {"name": "omt", **measured, **details}
    (finding,) = judge(sphere, sphere.vertices, [record], MapOptions())
    assert finding.kind == "not-converged"
    assert "omt did not converge: no step lowers the cost, 3 flipped" in str(finding)
    assert "remesh" in finding.remedy


def test_what_is_foretold_names_the_cause():
    assert next(finding.kind for finding in foretell(Surface(*large_face(0.4, 5)))) == "large-face"
    assert [finding.kind for finding in foretell(Surface(*prism(40, 0.02, "fan")))] == ["long-triangles", "thin-sheet"]
    assert "folded-triangles" in [finding.kind for finding in foretell(Surface(*creature(7, 190, 5)))]
    limb = foretell(flip_edges(tube(19.0, face_count=500), rounds=3))
    assert [finding.kind for finding in limb] == ["coarse-limb"]
    assert "vertices around a limb" in str(limb[0]) and 0 <= limb[0].where < 252


@pytest.mark.parametrize("scale", [1e-120, 1e140])
def test_what_is_foretold_does_not_depend_on_the_scale(scale):
    vertices, faces = large_face(0.3, 4)
    same = foretell(Surface(vertices, faces)), foretell(Surface(scale * vertices, faces))
    assert [(a.kind, a.where) for a in same[0]] == [(a.kind, a.where) for a in same[1]]


@pytest.mark.parametrize("area", [2.0000001, 100.0])
def test_an_area_distortion_that_no_map_has_is_said(area):
    """With the one that the nearest map has; with strict it is an error."""
    surface = blob(seed=3, sphere=320)
    with pytest.warns(OmtwarpWarning, match="no map with the area distortion"):
        result = map_to_sphere(surface, refine=f"match:{area}", optimality=False, device="cpu")
    (said,) = result.report["warnings"]
    reached = result.distortion().area["surface"]
    words = rf"no map with the area distortion {area:.9g} was found: this one has ([\d.]+); (remesh|ask for less)"
    found, remedy = re.match(words, said["text"]).groups()
    assert said["kind"] == "not-matched" and float(found) == pytest.approx(reached, abs=1e-7)
    assert (reached > area) == (remedy == "remesh")
    with pytest.raises(OmtwarpError, match="strict=True: no map with the area distortion"):
        map_to_sphere(surface, refine=f"match:{area}", optimality=False, device="cpu", strict=True)


def test_an_area_distortion_between_the_refined_and_the_conformal_map_is_matched():
    """A weight of areas down to a thousandth leads to it, in silence."""
    surface, area = blob(seed=3, sphere=1280), 2.6
    conformal, least = (
        map_to_sphere(surface, device="cpu", **one) for one in ({"until": "conformal"}, {"refine": 0.1})
    )
    assert least.distortion().area["surface"] < area < conformal.distortion().area["surface"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", OmtwarpWarning)
        result = map_to_sphere(surface, refine=f"match:{area}", optimality=False, device="cpu", strict=True)
    assert area - 2e-3 <= result.distortion().area["surface"] <= area + 1e-9
    assert result.distortion().angle["surface"] < least.distortion().angle["surface"]
