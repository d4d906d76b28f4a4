"""Every stage takes a surface in any form and a map of it, refuses anything else, and reports progress in one form."""

import inspect
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import trimesh

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, icosphere

SURFACE = blob(seed=2, amplitude=0.1, sphere=320)
START = SURFACE.vertices / np.linalg.norm(SURFACE.vertices, axis=1, keepdims=True)
FROM_SURFACE = {
    "conformal_map": omtwarp.conformal_map,
    "harmonic_points": omtwarp.harmonic_points,
    "barycentric_map": omtwarp.barycentric_map,
    "hierarchical_embedding": omtwarp.hierarchical_embedding,
}
FROM_MAP = {
    "mobius_centring": omtwarp.mobius_centring,
    "moser_map": omtwarp.moser_map,
    "optimal_map": lambda *args, **kw: omtwarp.optimal_map(*args, start=START, iterations=2, **kw),
    "optimal_transport": lambda *args, **kw: omtwarp.optimal_transport(*args, start=START, iterations=2, **kw),
    "paper_flow": lambda *args, **kw: omtwarp.paper_flow(*args, start=START, cycles=1, **kw),
    "refine_map": lambda *args, **kw: omtwarp.refine_map(*args, iterations=3, **kw),
    "untangle": omtwarp.untangle,
}
MEASURES = {
    "certify": omtwarp.certify,
    "distortion": omtwarp.distortion,
    "transport_cost": lambda *args, **kw: omtwarp.transport_cost(*args, start=START, **kw),
    "optimality": lambda *args, **kw: omtwarp.optimality(*args, start=START, **kw),
}
STAGES = {**FROM_SURFACE, **FROM_MAP}


def run(name, surface=SURFACE, sphere=START, **options):
    given = (surface,) if name in FROM_SURFACE else (surface, sphere)
    return STAGES[name](*given, device="cpu", **options)


@pytest.mark.parametrize("name", sorted({*STAGES, *MEASURES}))
def test_the_surface_and_the_map_come_first_and_options_by_name(name):
    function = getattr(omtwarp, name)
    parameters = list(inspect.signature(function).parameters.values())
    by_place = [parameter.name for parameter in parameters if parameter.kind is not parameter.KEYWORD_ONLY]
    assert by_place == (["surface"] if name in FROM_SURFACE else ["surface", "sphere"])
    assert "device" in inspect.signature(function).parameters


def test_every_public_stage_and_measure_is_held_to_this():
    """A function is one of them where it takes a surface first, which the weighting of a surface does without a map."""
    functions = {name: getattr(omtwarp, name) for name in omtwarp.__all__ if inspect.isfunction(getattr(omtwarp, name))}
    takes = {name for name, call in functions.items() if next(iter(inspect.signature(call).parameters)) == "surface"}
    assert takes - {"weighted_surface"} == {*STAGES, *MEASURES}
    for name in sorted(STAGES.keys() & functions.keys()):
        by_name = list(inspect.signature(functions[name]).parameters)
        assert {"device", "progress"} <= set(by_name), name


@pytest.mark.parametrize("name", STAGES)
def test_any_form_of_a_surface_is_taken_and_makes_the_same_map(name):
    expected = run(name)
    mesh = trimesh.Trimesh(SURFACE.vertices, SURFACE.faces, process=False)
    for form in (mesh, (SURFACE.vertices.tolist(), SURFACE.faces.astype(np.int64))):
        np.testing.assert_array_equal(run(name, form).sphere, expected.sphere)


@pytest.mark.parametrize("name", MEASURES)
def test_measures_take_a_surface_in_any_form_and_a_map_of_it(name):
    expected = str(MEASURES[name](SURFACE, START, device="cpu"))
    mesh = trimesh.Trimesh(SURFACE.vertices, SURFACE.faces, process=False)
    for form in (mesh, (SURFACE.vertices.tolist(), SURFACE.faces.astype(np.int64))):
        assert str(MEASURES[name](form, START, device="cpu")) == expected
    for message, mesh, sphere in (
        ("expected a trimesh", 7, START),
        ("expected a trimesh", SURFACE.faces, START),
        ("shape|points", SURFACE, START[:-1]),
    ):
        with pytest.raises(OmtwarpError, match=message) as caught:
            MEASURES[name](mesh, sphere, device="cpu")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", STAGES)
def test_results_are_frozen_and_have_a_map_a_history_and_an_end(name):
    result = run(name)
    assert result.sphere.shape == START.shape and result.sphere.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(result.sphere, axis=1), 1.0, rtol=0, atol=1e-14)
    assert all(isinstance(record, dict) for record in result.history)
    assert isinstance(result.converged, bool | np.bool_)
    with pytest.raises(FrozenInstanceError):
        result.sphere = None


@pytest.mark.parametrize("name", sorted(set(STAGES) - {"untangle"}))
def test_progress_is_told_with_stage_done_total_and_details(name):
    told = []
    turn = np.array([[np.cos(0.2), -np.sin(0.2), 0.0], [np.sin(0.2), np.cos(0.2), 0.0], [0.0, 0.0, 1.0]])
    run(name, sphere=START @ turn.T, progress=lambda *arguments: told.append(arguments))
    assert told
    for stage, done, total, details in told:
        assert type(stage) is str and 0 <= done <= total
        assert isinstance(details, dict)


@pytest.mark.parametrize("name", ["optimal_map", "refine_map"])
def test_progress_that_is_no_function_is_refused(name):
    with pytest.raises(OmtwarpError, match="must be a function"):
        run(name, progress="bar")


def test_untangling_tells_of_its_attempts():
    told = []
    sphere = START.copy()
    corner, across = SURFACE.faces[0, :2]  # a corner mirrored at its neighbour: triangles around both are flipped
    sphere[corner] = 2.0 * sphere[across] - sphere[corner]
    sphere[corner] /= np.linalg.norm(sphere[corner])
    result = omtwarp.untangle(SURFACE, sphere, device="cpu", progress=lambda *arguments: told.append(arguments))
    assert result.converged
    assert told[0][:2] == ("untangle", 0) and told[0][3]["tangled"] > 0


@pytest.mark.parametrize("name", STAGES)
def test_surfaces_that_cannot_be_mapped_are_refused(name):
    hole = np.where(np.arange(SURFACE.vertex_count) == 4, np.nan, 1.0)[:, None]
    cases = {
        "boundary": (SURFACE.vertices, SURFACE.faces[1:]),
        "finite": (SURFACE.vertices * hole, SURFACE.faces),
        "shape": (SURFACE.vertices[:, :2], SURFACE.faces),
        "expected a trimesh": 7,
    }
    for message, mesh in cases.items():
        with pytest.raises(OmtwarpError, match=message) as caught:
            run(name, mesh)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", FROM_MAP)
def test_maps_that_are_none_are_refused(name):
    cases = {
        r"shape|points": START[:-1],
        "not finite, first in row 4": np.where(np.arange(len(START)) == 4, np.nan, 1.0)[:, None] * START,
        "centre": np.where(np.arange(len(START)) == 4, 0.0, 1.0)[:, None] * START,
        "real numbers": "sphere",
    }
    for message, sphere in cases.items():
        with pytest.raises(OmtwarpError, match=message) as caught:
            run(name, sphere=sphere)
        assert "\n" not in str(caught.value)


def test_a_surface_is_examined_once(monkeypatch):
    surface = omtwarp.Surface(SURFACE.vertices, SURFACE.faces)
    assert not surface.checked
    omtwarp.moser_map(surface, START, device="cpu")
    assert surface.checked
    monkeypatch.setattr("omtwarp.mesh.surface.require_valid", lambda *_: pytest.fail("examined again"))
    omtwarp.moser_map(surface, START, device="cpu")


def test_maps_that_are_not_on_the_sphere_are_refused():
    surface = icosphere(4)
    with pytest.raises(OmtwarpError, match="162 points of the map are not on the unit sphere"):
        omtwarp.moser_map(surface, 3.0 * surface.vertices, device="cpu")
