"""Every kind of map is the same on the fake device as on the CPU, stage by stage, to 1e-10."""

import json

import numpy as np
import pytest

import omtwarp
from omtwarp.measures import TargetDensity
from omtwarp.mesh.shapes import blob, limbs, rings

pytestmark = pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")  # of maps by less than the default stages
SURFACE = blob(seed=11, amplitude=0.4, sphere=1500)
SPHERES = {
    "default": {},
    "refined": {"refine": "balanced"},
    "matched": {"refine": "match:2.01"},
    "exact": {"exact": True},
    "geodesic": {"cost": "geodesic"},
    "plain": {"scheme": "plain"},
    "paper": {"scheme": "paper"},
    "moser": {"until": "moser"},
}
STAGES = ("conformal", "moser", "transported", "sphere")


def numbers(record, name=""):
    """Yield every number of a report with the path to it, but times and iterations of solvers."""
    if isinstance(record, dict):
        for key, value in record.items():
            if key not in ("seconds", "device", "solver", "history", "cpu_seconds"):
                yield from numbers(value, f"{name}.{key}")
    elif isinstance(record, list):
        for place, value in enumerate(record):
            yield from numbers(value, f"{name}.{place}")
    elif isinstance(record, int | float):
        yield name, record


def assert_same_map(one, other):
    for name in STAGES:
        here, there = getattr(one, name), getattr(other, name)
        assert (here is None) is (there is None)
        if here is not None:
            np.testing.assert_allclose(there, here, rtol=0.0, atol=1e-10, err_msg=name)
    here, there = (dict(numbers(json.loads(json.dumps(mapped.report)))) for mapped in (one, other))
    assert here.keys() == there.keys()
    for name, value in here.items():
        assert there[name] == pytest.approx(value, rel=1e-6, abs=1e-9, nan_ok=True), name


@pytest.mark.parametrize("variant", SPHERES)
def test_maps_to_the_sphere(fake, variant):
    one, other = (omtwarp.map_to_sphere(SURFACE, device=where, **SPHERES[variant]) for where in ("cpu", "cuda:0"))
    assert_same_map(one, other)
    assert fake.downloads


def test_a_map_with_limbs_that_needs_repairs(fake):
    """Repairs make rounding larger, along directions in which the cost is flat: the maps are equally good."""
    surface = limbs(length=4.0, sphere=2000)
    one, other = (omtwarp.map_to_sphere(surface, device=where) for where in ("cpu", "cuda:0"))
    assert one.bijective and other.bijective
    assert np.sqrt(np.mean((one.sphere - other.sphere) ** 2)) < 0.02
    costs = [result.report["optimality"]["cost"] for result in (one, other)]
    assert costs[1] == pytest.approx(costs[0], rel=1e-3)


def test_a_map_to_a_density(fake):
    target = TargetDensity(lambda points: 1.5 + points[:, 2])
    assert_same_map(*(omtwarp.map_to_sphere(SURFACE, target=target, device=where) for where in ("cpu", "cuda:0")))


@pytest.mark.parametrize("domain", ["hemisphere", "disk", "cap", "sphere"])
def test_maps_of_an_open_surface(fake, domain):
    vertices, faces = SURFACE.vertices, SURFACE.faces
    low = vertices[:, 2] < np.quantile(vertices[:, 2], 0.7)
    used, own = np.unique(faces[low[faces].all(axis=1)], return_inverse=True)
    mesh = vertices[used], own.reshape(-1, 3)
    one, other = (omtwarp.map_surface(mesh, domain=domain, device=where) for where in ("cpu", "cuda:0"))
    np.testing.assert_allclose(other.sphere, one.sphere, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("options", [{}, {"exact": True}, {"refine": 10.0}, {"refine": "match:2.05"}], ids=str)
def test_a_map_to_the_torus(fake, options):
    surface = rings(1, cell=0.25)
    one, other = (omtwarp.map_surface(surface, device=where, **options) for where in ("cpu", "cuda:0"))
    np.testing.assert_allclose(other.coordinates, one.coordinates, rtol=0.0, atol=1e-10)
    assert any(place.startswith("omtwarp.optimal.plane") for place in fake.uploads)
