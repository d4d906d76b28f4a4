"""Exact maps of scanned surfaces: areas of triangles, optimality, and smoothness beside the default map."""

import pytest
from sphere_truths import SHARED, judge

import omtwarp
from omtwarp.mesh.read import read_mesh


@pytest.mark.parametrize("name", ["spot_6k", "bucket_10k"])
def test_exact_maps_are_optimal_and_smoother_than_the_default(name):
    """Exact maps have areas right to 1e-6 and a gap of 0.1 %, and their metric jumps less than the default map's."""
    file = SHARED / "data" / f"{name}.ply"
    if not file.is_file():
        pytest.skip(f"{name}.ply is not there")
    mesh, judged = read_mesh(file), judge()
    default = omtwarp.map_to_sphere(mesh, optimality=False, device="cpu")
    exact = omtwarp.map_to_sphere(mesh, exact=True, device="cpu")
    (stage,) = (stage for stage in exact.report["stages"] if stage["name"] == "exact")
    assert stage["converged"] and stage["largest_area_error"] <= 1e-6
    assert exact.report["optimality"]["gap"] <= 1e-3
    before, after = (judged(result.vertices, result.sphere, result.faces) for result in (default, exact))
    assert after["flips"] == 0 and after["degree"] == pytest.approx(1.0)
    assert after["jump"] < before["jump"]
