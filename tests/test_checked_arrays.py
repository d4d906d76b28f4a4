"""Arrays that callers hand over: whatever is wrong with them is told in one line before any kernel runs."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.result import MapResult

SURFACE = blob(seed=3, amplitude=0.2, degree=3, sphere=80)
VERTICES, FACES = SURFACE.vertices, SURFACE.faces
SPHERE = VERTICES / np.linalg.norm(VERTICES, axis=1, keepdims=True)
COUNT = len(VERTICES)


def broken_points():
    """Arrays [V, 3] that are none, by what is wrong with them."""
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
    """Arrays [F, 3] that are none."""
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
TAKES_FACES = {
    "distortion": lambda faces: omtwarp.distortion((VERTICES, faces), SPHERE),
    "certify": lambda faces: omtwarp.certify((VERTICES, faces), SPHERE),
    "Surface": lambda faces: omtwarp.Surface(VERTICES, faces),
    "map_to_sphere": lambda faces: omtwarp.map_to_sphere((VERTICES, faces)),
    "MapResult": lambda faces: MapResult(VERTICES, faces, SPHERE, SPHERE, np.ones(COUNT)),
}


def refuse(call, value):
    with pytest.raises(OmtwarpError) as caught:
        call(value)
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize("case", broken_points())
@pytest.mark.parametrize("function", TAKES_POINTS)
def test_points_that_are_none(function, case):
    if function.endswith("moser") and case == "nothing":
        return  # left out
    refuse(TAKES_POINTS[function], broken_points()[case])


@pytest.mark.parametrize("case", broken_faces())
@pytest.mark.parametrize("function", TAKES_FACES)
def test_faces_that_are_none(function, case):
    refuse(TAKES_FACES[function], broken_faces()[case])


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


def test_points_off_the_sphere_are_normalised_or_refused():
    """Stages take directions of any length but 0; a result holds unit vectors and nothing else."""
    once = omtwarp.transport_cost(SURFACE, SPHERE @ np.diag([1.0, -1.0, -1.0]), start=SPHERE)
    lengths = np.random.default_rng(1).uniform(1e-200, 1e200, COUNT)[:, None]
    again = omtwarp.transport_cost(SURFACE, SPHERE @ np.diag([1.0, -1.0, -1.0]), start=SPHERE * lengths)
    assert again == pytest.approx(once, rel=1e-12)
    refuse(lambda points: MapResult(VERTICES, FACES, points, SPHERE, np.ones(COUNT)), 1.01 * SPHERE)
    at_the_centre = SPHERE.copy()
    at_the_centre[9] = 0.0
    for call in (TAKES_POINTS["untangle"], TAKES_POINTS["moser_map"], TAKES_POINTS["MapResult, sphere"]):
        refuse(call, at_the_centre)


@pytest.mark.parametrize("exponent", [-160, -120, 0, 120, 160])
def test_any_unit_gives_the_same_figures(exponent):
    """Areas of coordinates of 1e±160 are beyond float64; the figures are not."""
    plain = omtwarp.distortion((VERTICES, FACES), SPHERE)
    scaled = omtwarp.distortion((VERTICES * 10.0**exponent, FACES), SPHERE)
    assert scaled.area == pytest.approx(plain.area, rel=1e-12) and scaled.angle == pytest.approx(plain.angle, rel=1e-12)
    mapped = omtwarp.map_to_sphere((VERTICES * 10.0**exponent, FACES), until="moser")
    assert np.isfinite(mapped.report["stages"][-1]["area"]["surface"]) and np.isfinite(mapped.distortion().area["max"])


def test_a_negated_sphere_is_not_certified_by_its_file(tmp_path):
    """What a file says of its map is measured again."""
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
