"""Mistakes in the arrays that callers pass are named in one line before any kernel runs."""

import os
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import omtwarp
from omtwarp.cohort.tables import read_table
from omtwarp.errors import OmtwarpError
from omtwarp.location import Locator
from omtwarp.maps.result import MapResult
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.registration import register_group, register_sequence
from omtwarp.shape_analysis import expand, study_group
from omtwarp.texturing import pattern, rasterize
from omtwarp.wavelets import level_for


@pytest.fixture(autouse=True, scope="module")
def elsewhere(tmp_path_factory):
    """Work in a folder of its own: a word that is taken for the name of a file may be written."""
    before = os.getcwd()
    os.chdir(tmp_path_factory.mktemp("words"))
    yield
    os.chdir(before)


SURFACE = blob(seed=3, amplitude=0.2, degree=3, sphere=80)
VERTICES, FACES = SURFACE.vertices, SURFACE.faces
SPHERE = VERTICES / np.linalg.norm(VERTICES, axis=1, keepdims=True)
COUNT = len(VERTICES)
MAP = MapResult(VERTICES, FACES, SPHERE, SPHERE, np.ones(COUNT))


def surface_map(**arrays):
    """A map to the sphere as a :class:`MapResult`, with some arrays more."""
    return omtwarp.MapResult(VERTICES, FACES, SPHERE, SPHERE, np.ones(COUNT), **arrays)


def torus_map(**arrays):
    """Something of the form of a map to a torus, some arrays replaced."""
    plain = {"vertices": VERTICES, "faces": FACES, "coordinates": SPHERE[:, :2], "conformal": SPHERE[:, :2]}
    plain |= {"wraps": np.zeros((len(FACES), 3, 2), dtype=int), "lattice": np.eye(2)}
    return omtwarp.MapResult(domain="torus", **(plain | arrays))


def broken_points():
    """Return values that are no arrays [V, 3], by what is wrong with each."""
    holed, masked = VERTICES.copy(), np.ma.array(VERTICES, mask=np.zeros(VERTICES.shape, dtype=bool))
    holed[5, 1] = np.nan
    masked[2, 0] = np.ma.masked
    return {
        "complex": VERTICES + 0.5j,
        "objects": VERTICES.astype(object),
        "text": VERTICES.astype(str),
        "truth values": VERTICES > 0,
        "masked": masked,
        "not a number": holed,
        "infinite": np.where(VERTICES == VERTICES.max(), np.inf, VERTICES),
        "short": VERTICES[:-1],
        "flat": VERTICES.ravel(),
        "transposed": VERTICES.T,
        "two columns": VERTICES[:, :2],
        "ragged": [[0.0, 1.0, 2.0], [0.0]],
        "nothing": None,
        "a word": "sphere",
    }


def broken_faces():
    """Return values that are no arrays of faces [F, 3]."""
    beyond, negative = FACES.copy(), FACES.copy()
    beyond[7, 1], negative[3, 2] = COUNT, -1
    masked = np.ma.array(FACES, mask=FACES == FACES[4, 0])
    cases = {"beyond": beyond, "negative": negative, "half": FACES + 0.5, "masked": masked, "complex": FACES + 0j}
    cases |= {"text": FACES.astype(str), "quads": np.column_stack([FACES, FACES[:, 0]]), "flat": FACES.ravel()}
    return cases | {
        "not a number": np.full(FACES.shape, np.nan),
        "huge": FACES.astype(np.int64) + 2**40,
        "nothing": None,
    }


TAKES_POINTS = {
    "distortion, vertices": lambda points: omtwarp.distortion((points, FACES), SPHERE),
    "map_to_sphere": lambda points: omtwarp.map_to_sphere((points, FACES)),
    "transport_cost, start": lambda points: omtwarp.transport_cost(SURFACE, SPHERE, start=points),
    "transport_cost, sphere": lambda points: omtwarp.transport_cost(SURFACE, points, start=SPHERE),
    "moser_map": lambda points: omtwarp.moser_map(SURFACE, points),
    "untangle": lambda points: omtwarp.untangle(SURFACE, points),
    "refine_map": lambda points: omtwarp.refine_map(SURFACE, points),
    "optimal_transport, start": lambda points: omtwarp.optimal_transport(SURFACE, SPHERE, start=points),
    "optimal_transport, initial": lambda points: omtwarp.optimal_transport(SURFACE, points, start=SPHERE),
    "mobius_centring": lambda points: omtwarp.mobius_centring(SURFACE, points),
    "MapResult, sphere": lambda points: MapResult(VERTICES, FACES, points, SPHERE, np.ones(COUNT)),
    "MapResult, vertices": lambda points: MapResult(points, FACES, SPHERE, SPHERE, np.ones(COUNT)),
    "MapResult, moser": lambda points: MapResult(VERTICES, FACES, SPHERE, SPHERE, np.ones(COUNT), moser=points),
}
TAKES_POINTS |= {
    "optimal_map, sphere": lambda points: omtwarp.optimal_map(SURFACE, points, start=SPHERE),
    "optimal_map, start": lambda points: omtwarp.optimal_map(SURFACE, SPHERE, start=points),
    "paper_flow, sphere": lambda points: omtwarp.paper_flow(SURFACE, points, start=SPHERE, cycles=1),
    "paper_flow, start": lambda points: omtwarp.paper_flow(SURFACE, SPHERE, start=points, cycles=1),
    "optimality, start": lambda points: omtwarp.optimality(SURFACE, SPHERE, start=points),
    "optimality, sphere": lambda points: omtwarp.optimality(SURFACE, points, start=SPHERE),
    "conformal_map": lambda points: omtwarp.conformal_map((points, FACES)),
    "barycentric_map": lambda points: omtwarp.barycentric_map((points, FACES)),
    "hierarchical_embedding": lambda points: omtwarp.hierarchical_embedding((points, FACES)),
    "map_surface": lambda points: omtwarp.map_surface((points, FACES)),
    "texture, vertices": lambda points: omtwarp.texture((points, FACES, SPHERE)),
    "texture, sphere": lambda points: omtwarp.texture((VERTICES, FACES, points)),
    "align": lambda points: omtwarp.align((points, FACES), MAP),
    "align, to": lambda points: omtwarp.align(MAP, (points, FACES)),
    "resample": lambda points: omtwarp.resample((points, FACES), MAP),
    "resample, target": lambda points: omtwarp.resample(MAP, (points, FACES)),
    "MapResult, source": lambda points: MapResult(VERTICES, FACES, SPHERE, SPHERE, np.ones(COUNT), source=points),
    "MapResult, filled": lambda points: surface_map(filled_vertices=VERTICES, filled_sphere=points),
    "torus": lambda points: torus_map(vertices=points),
    "Locator": lambda points: Locator(points, FACES),
    "expand": lambda points: expand(points, VERTICES, 2),
}
TAKES_A_SPHERE = {
    name for name in TAKES_POINTS if name.endswith((", sphere", ", start", ", source", ", moser", ", initial"))
}
TAKES_A_SPHERE |= {"moser_map", "untangle", "refine_map", "mobius_centring", "MapResult, filled"}
TAKES_FACES = {
    "distortion": lambda faces: omtwarp.distortion((VERTICES, faces), SPHERE),
    "certify": lambda faces: omtwarp.certify((VERTICES, faces), SPHERE),
    "Surface": lambda faces: omtwarp.Surface(VERTICES, faces),
    "Locator": lambda faces: Locator(SPHERE, faces),
    "map_to_sphere": lambda faces: omtwarp.map_to_sphere((VERTICES, faces)),
    "MapResult": lambda faces: MapResult(VERTICES, faces, SPHERE, SPHERE, np.ones(COUNT)),
    "MapResult, filled": lambda faces: surface_map(filled_faces=[[0, 1, 2.5]] if faces is None else faces),
    "torus": lambda faces: torus_map(faces=faces),
    "optimality": lambda faces: omtwarp.optimality((VERTICES, faces), SPHERE, start=SPHERE),
    "texture": lambda faces: omtwarp.texture((VERTICES, faces, SPHERE)),
    "align": lambda faces: omtwarp.align((SPHERE, faces), MAP),
    "resample": lambda faces: omtwarp.resample((SPHERE, faces), MAP),
}


def broken_numbers():
    """Return values that are no arrays of numbers [V]."""
    plain = np.ones(COUNT)
    cases = {"complex": plain + 0.5j, "objects": plain.astype(object), "text": plain.astype(str)}
    cases |= {"truth values": plain > 0, "masked": np.ma.array(plain, mask=np.arange(COUNT) == 3)}
    cases |= {"not a number": np.where(np.arange(COUNT) == 4, np.nan, plain), "infinite": np.full(COUNT, np.inf)}
    cases |= {"short": plain[1:], "empty": [], "two columns": np.ones((COUNT, 2))}
    return cases | {"a word": "x", "a dictionary": {}}


def in_two_columns(numbers):
    """Numbers [V] as points [V, 2]; what has another shape gets one row too many."""
    return np.ma.stack([numbers, numbers], axis=1) if np.ndim(numbers) == 1 else np.ones((COUNT + 1, 2))


TAKES_NUMBERS = {
    "mobius_centring": lambda numbers: omtwarp.mobius_centring(SURFACE, SPHERE, masses=numbers),
    "optimality, masses": lambda numbers: omtwarp.optimality(SURFACE, SPHERE, start=SPHERE, masses=numbers),
    "optimality, potential": lambda numbers: omtwarp.optimality(SURFACE, SPHERE, start=SPHERE, potential=numbers),
    "optimal_map, multipliers": lambda numbers: omtwarp.optimal_map(
        SURFACE, SPHERE, start=SPHERE, multipliers=numbers, iterations=1
    ),
    "weighted_surface": lambda numbers: omtwarp.weighted_surface(SURFACE, numbers),
    "map_to_sphere, weights": lambda numbers: omtwarp.map_to_sphere(SURFACE, weights=numbers),
    "MapResult, density": lambda numbers: MapResult(VERTICES, FACES, SPHERE, SPHERE, numbers),
    "MapResult, target": lambda numbers: MapResult(VERTICES, FACES, SPHERE, SPHERE, np.ones(COUNT), target=numbers),
    "align, features": lambda numbers: omtwarp.align(
        MAP, MAP, features={"a": numbers}, to_features={"a": VERTICES[:, 0]}, by="features"
    ),
    "resample, areas": lambda numbers: omtwarp.resample(MAP, MAP, method="adaptive", source_areas=numbers),
    "MapResult, disk": lambda numbers: surface_map(domain="disk", disk=in_two_columns(numbers)),
    "torus, coordinates": lambda numbers: torus_map(coordinates=in_two_columns(numbers)),
}

# What an option that is a number may be given instead: only the first four are numbers.
BROKEN_NUMBER = (float("nan"), float("inf"), -1, 10**400, "x", "", None, 1j, [1, 2], np.ones(3), {}, b"x", object())
TAKES_A_NUMBER = {
    "hierarchical_embedding": lambda value: omtwarp.hierarchical_embedding(SURFACE, area_weight=value),
    "optimal_map, shape_weight": lambda value: omtwarp.optimal_map(SURFACE, SPHERE, start=SPHERE, shape_weight=value),
    "optimal_map, gain": lambda value: omtwarp.optimal_map(SURFACE, SPHERE, start=SPHERE, gain=value),
    "optimal_map, iterations": lambda value: omtwarp.optimal_map(SURFACE, SPHERE, start=SPHERE, iterations=value),
    "optimal_transport": lambda value: omtwarp.optimal_transport(SURFACE, SPHERE, start=SPHERE, tolerance=value),
    "paper_flow, cycles": lambda value: omtwarp.paper_flow(SURFACE, SPHERE, start=SPHERE, cycles=value),
    "refine_map, tolerance": lambda value: omtwarp.refine_map(SURFACE, SPHERE, tolerance=value),
    "refine_map, iterations": lambda value: omtwarp.refine_map(SURFACE, SPHERE, iterations=value),
    "map_optimality": lambda value: omtwarp.map_optimality(MAP, ascent_steps=value),
    "align": lambda value: omtwarp.align(MAP, MAP, degree=value),
    "preview, frames": lambda value: omtwarp.preview(SURFACE, frames=0 if value is None else value, backend="rays"),
    "rasterize, width": lambda value: rasterize("checker", value),
    "unwrap_uv, aspect": lambda value: omtwarp.unwrap_uv(MAP, aspect=value),
    "unwrap_uv, margin": lambda value: omtwarp.unwrap_uv(MAP, margin=value),
    "checker, rows": lambda value: pattern("checker", rows=value),
    "checker, columns": lambda value: pattern("checker", columns=value),
    "puzzle, seed": lambda value: pattern("puzzle", seed=value),
    "write_report, picture_size": lambda value: omtwarp.write_report(MAP, "a.html", picture_size=value, device="cpu"),
    "level_for, lowest": lambda value: level_for(12, lowest=value),
    "preview, fps": lambda value: omtwarp.preview(SURFACE, frames=1, fps=value, backend="rays"),
}
BROKEN_NAME = ("x", "", -1, 1j, [1, 2], np.ones(3), {}, b"x", object())
TAKES_A_NAME = {
    "method": lambda value: omtwarp.map_to_sphere(SURFACE, method=value),
    "until": lambda value: omtwarp.map_to_sphere(SURFACE, until=value),
    "refine": lambda value: omtwarp.map_to_sphere(SURFACE, refine=value),
    "device": lambda value: omtwarp.map_to_sphere(SURFACE, device=value),
    "solver": lambda value: omtwarp.map_to_sphere(SURFACE, solver=value),
    "moser_map, solver": lambda value: omtwarp.moser_map(SURFACE, SPHERE, solver=value, device="cpu"),
    "domain": lambda value: omtwarp.map_surface(SURFACE, domain=value),
    "MapResult's domain": lambda value: surface_map(domain=value),
    "align, by": lambda value: omtwarp.align(MAP, MAP, by=value),
    "resample, method": lambda value: omtwarp.resample(MAP, MAP, method=value),
    "texture, atlas": lambda value: omtwarp.texture(MAP, atlas=value),
    "distortion of a stage": MAP.distortion,
    "optimality of a stage": lambda value: omtwarp.map_optimality(MAP, value),
}
BROKEN_TRUTH = ("no", "", [], [True], np.ones(3), np.array(False), {})
TAKES_A_TRUTH = {
    "exact": lambda value: omtwarp.map_to_sphere(SURFACE, exact=value),
    "strict": lambda value: omtwarp.map_surface(SURFACE, strict=value),
    "align, mirror": lambda value: omtwarp.align(MAP, MAP, mirror=value),
    "align, check": lambda value: omtwarp.align(MAP, MAP, check=value),
    "texture, smooth": lambda value: omtwarp.texture(MAP, size=16, smooth=value),
    "transfer_texture, aligned": lambda value: omtwarp.transfer_texture(
        omtwarp.PaintedMesh(VERTICES, FACES, vertex_colors=np.ones((COUNT, 4), np.uint8)), MAP, MAP, aligned=value
    ),
    "preview, transparent": lambda value: omtwarp.preview(SURFACE, transparent=value, backend="warp"),
    "preview, wireframe": lambda value: omtwarp.preview(SURFACE, wireframe=value, backend="warp"),
    "preview, color_bar": lambda value: omtwarp.preview(SURFACE, color_bar=value, backend="warp"),
    "film, captions": lambda value: omtwarp.film(MAP, "a.gif", size=(32, 32), captions=value, backend="warp"),
}
# Files that do not exist; no number is a name.
BROKEN_PATH = (1, 0.5, None, 1j, [1], {}, object())
TAKES_A_PATH = {
    "read_mesh": omtwarp.read_mesh,
    "load": MapResult.load,
    "save": MAP.save,
    "write_report": lambda value: omtwarp.write_report(MAP, value),
    "read_table": read_table,
    "register_group": lambda value: register_group([value, MAP], "out"),
    "register_sequence": lambda value: register_sequence([value, MAP], "out"),
}


def refuse(call, value):
    with pytest.raises(OmtwarpError) as caught:
        call(value)
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize("case", broken_points())
@pytest.mark.parametrize("function", TAKES_POINTS)
def test_points_that_are_none(function, case):
    if function.endswith(("moser", "source", "filled")) and case == "nothing":
        return  # left out
    refuse(TAKES_POINTS[function], broken_points()[case])


@pytest.mark.parametrize("case", broken_faces())
@pytest.mark.parametrize("function", TAKES_FACES)
def test_faces_that_are_none(function, case):
    refuse(TAKES_FACES[function], broken_faces()[case])


@pytest.mark.parametrize("function", TAKES_NUMBERS)
def test_numbers_at_vertices_that_are_none(function):
    for value in broken_numbers().values():
        refuse(TAKES_NUMBERS[function], value)


@pytest.mark.parametrize("function", TAKES_A_NUMBER)
def test_options_that_are_no_number(function):
    for value in BROKEN_NUMBER:
        refuse(TAKES_A_NUMBER[function], value)


@pytest.mark.parametrize("function", TAKES_A_NAME)
def test_options_that_are_no_name(function):
    for value in BROKEN_NAME:
        refuse(TAKES_A_NAME[function], value)


@pytest.mark.parametrize("function", TAKES_A_TRUTH)
def test_options_that_are_neither_true_nor_false(function):
    for value in BROKEN_TRUTH:
        with pytest.raises(OmtwarpError, match="must be True or False"):
            TAKES_A_TRUTH[function](value)


@pytest.mark.parametrize("value", [3, "x", [1], np.ones(3)])
def test_progress_that_is_no_function(value):
    with pytest.raises(OmtwarpError, match=r"progress .*: must be a function"):
        omtwarp.map_to_sphere(SURFACE, progress=value)


@pytest.mark.parametrize("name", ["color", "emission", "metallic", "roughness"])
def test_materials_that_are_none(name):
    for value in ("x", None, np.nan, [np.nan] * 3, [1.0, 2.0], 1j, {}, np.ones((4, 1))):
        with pytest.raises(OmtwarpError, match=name):
            omtwarp.Material(**{name: value})
    grey = np.zeros((4, 4), np.uint8)
    for value in ("x.png", 3, grey, np.zeros((4, 4, 3)), np.zeros((4, 0, 3), np.uint8), [[[0, 0, 0]]]):
        with pytest.raises(OmtwarpError, match="picture: must be a picture"):
            omtwarp.Material(picture=value)
    for value in (3, None, ["red"], b"red"):
        with pytest.raises(OmtwarpError, match="name: must be text"):
            omtwarp.Material(value)
    for value in ("x", 3, None, [None], np.ones(3)):
        with pytest.raises(OmtwarpError, match=r"materials: must be a list of omtwarp\.Material"):
            omtwarp.PaintedMesh(VERTICES, FACES, materials=value)


def test_frames_that_turn_no_map():
    for value in ("x", None, 1j, np.eye(2), np.ones(3), np.full((3, 3), np.nan), [[1, 0], [0]]):
        with pytest.raises(OmtwarpError, match="frame"):
            MAP.turned(value)


@pytest.mark.parametrize("function", TAKES_A_PATH)
def test_paths_that_are_none(function):
    for value in BROKEN_PATH:
        refuse(TAKES_A_PATH[function], value)


def test_names_of_files_are_no_maps_and_maps_no_names_of_files():
    with pytest.raises(OmtwarpError, match=r"maps: must be a list of omtwarp\.MapResult"):
        study_group(["a.npz", "b.npz"])
    for register_all in (register_group, register_sequence):
        with pytest.raises(OmtwarpError, match="must be text or a path, not a MapResult"):
            register_all([MAP, MAP], "out")


def test_a_table_is_read_by_its_name_as_text(tmp_path):
    (tmp_path / "table.csv").write_text("id,area\na,2.5\n", encoding="utf-8")
    assert read_table(str(tmp_path / "table.csv")) == read_table(tmp_path / "table.csv")


def test_mosers_flow_takes_the_name_of_a_solver():
    plain, named = (omtwarp.moser_map(SURFACE, SPHERE, solver=one, device="cpu").sphere for one in (None, "scipy"))
    np.testing.assert_allclose(named, plain, atol=1e-9)


def test_maps_of_every_kind_own_their_arrays():
    """Maps of every kind own their arrays: a caller's later changes do not reach them."""
    disk, lattice = np.zeros((COUNT, 2)), np.eye(2)
    one, two = surface_map(domain="disk", disk=disk), torus_map(lattice=lattice)
    disk += 1.0
    lattice *= 2.0
    assert not one.disk.any() and np.array_equal(two.lattice, np.eye(2))
    for array in (one.disk, one.vertices, two.lattice, two.coordinates, two.faces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


@pytest.mark.parametrize(("made", "missing"), [(surface_map, "lattice"), (torus_map, "sphere")])
def test_arrays_of_maps_to_other_domains_are_named(made, missing):
    """What maps to the domain do not have is an error where it is read or given, and no attribute."""
    result = made()
    with pytest.raises(OmtwarpError, match=f"domain of this map is '{result.domain}': it has no '{missing}'"):
        getattr(result, missing)
    with pytest.raises(OmtwarpError, match=f"domain is '{result.domain}' has no '{missing}'"):
        made(**{missing: SPHERE})
    assert not hasattr(result, missing) and missing not in result.maps and result.moser is None
    assert replace(result, report={"seconds": 1.0}).conformal is result.conformal


@pytest.mark.parametrize(
    "convert",
    [np.asfortranarray, lambda a: np.repeat(a, 2, axis=0)[::2], np.ndarray.tolist, lambda a: a.astype(">f8")],
    ids=["columns first", "strided", "lists", "other byte order"],
)
def test_order_and_layout_of_arrays_do_not_matter(convert):
    plain = omtwarp.distortion((VERTICES, FACES), SPHERE).to_dict()
    assert omtwarp.distortion((convert(VERTICES), convert(FACES)), convert(SPHERE)).to_dict() == plain
    assert omtwarp.certify((convert(VERTICES), convert(FACES)), convert(SPHERE)).bijective


def test_stages_refuse_surfaces_that_cannot_be_mapped():
    bent = trimesh.creation.torus(1.0, 0.3)
    ring = omtwarp.Surface(bent.vertices, bent.faces)
    sphere = ring.vertices / np.linalg.norm(ring.vertices, axis=1, keepdims=True)
    open_sphere = omtwarp.Surface(VERTICES, FACES[1:])
    for call in (
        lambda: omtwarp.conformal_map(ring),
        lambda: omtwarp.conformal_map(open_sphere),
        lambda: omtwarp.barycentric_map(ring),
        lambda: omtwarp.moser_map(ring, sphere),
        lambda: omtwarp.untangle(ring, sphere),
        lambda: omtwarp.refine_map(open_sphere, SPHERE),
        lambda: omtwarp.optimal_transport(ring, sphere, start=sphere),
    ):
        with pytest.raises(OmtwarpError, match=r"genus 1|open boundary"):
            call()


@pytest.mark.parametrize("length", [0.0, 0.999, 1.01, 1e200])
def test_points_off_the_sphere_are_refused(length):
    """A sphere of another radius, or a point at its centre, is a mistake; rounding to float32 is none."""
    sphere = SPHERE.copy()
    sphere[9] *= length
    for name in TAKES_A_SPHERE:
        with pytest.raises(OmtwarpError, match=r"1 points of .* not on the unit sphere, first vertex 9"):
            TAKES_POINTS[name](sphere)
    once = omtwarp.transport_cost(SURFACE, SPHERE @ np.diag([1.0, -1.0, -1.0]), start=SPHERE)
    again = omtwarp.transport_cost(SURFACE, SPHERE @ np.diag([1.0, -1.0, -1.0]), start=SPHERE.astype(np.float32))
    assert again == pytest.approx(once, rel=1e-6)


@pytest.mark.parametrize("exponent", [-160, -120, 0, 120, 160])
def test_any_unit_gives_the_same_figures(exponent):
    """Areas of coordinates of 1e±160 are beyond float64; the figures are not."""
    plain = omtwarp.distortion((VERTICES, FACES), SPHERE)
    scaled = omtwarp.distortion((VERTICES * 10.0**exponent, FACES), SPHERE)
    assert scaled.area == pytest.approx(plain.area, rel=1e-12) and scaled.angle == pytest.approx(plain.angle, rel=1e-12)
    mapped = omtwarp.map_to_sphere((VERTICES * 10.0**exponent, FACES), until="moser")
    assert np.isfinite(mapped.report["stages"][-1]["area"]["surface"]) and np.isfinite(mapped.distortion().area["max"])


def test_a_negated_sphere_is_not_certified_by_its_file(tmp_path):
    """A map with a negated sphere has flips, whatever certificate its file holds."""
    sphere = icosphere(3)
    result = omtwarp.map_to_sphere(sphere, until="moser")
    assert result.bijective
    path = tmp_path / "map.npz"
    arrays = {name: getattr(result, name) for name in ("vertices", "faces", "conformal", "density")}
    report = np.array('{"certificate": {"bijective": true, "flips": 0}}')
    np.savez(path, sphere=-result.sphere, report=report, **arrays)
    again = MapResult.load(path)
    assert not again.bijective and again.report["certificate"]["flips"] == len(sphere.faces)


@given(st.integers(0, 2**31), st.sampled_from([np.int8, np.uint8, np.int16, np.uint64, np.float32, np.float16]))
def test_faces_of_every_type_that_holds_them(seed, dtype):
    order = np.random.default_rng(seed).permutation(len(FACES))
    assert omtwarp.certify((VERTICES, FACES[order].astype(dtype)), SPHERE).bijective
