"""Equation 12 itself: steepest descent where the mesh resolves it, slower than the default, as careful with areas."""

from sphere_truths import pushed_north, turned, twisted

from omtwarp.flips.exact import count_flips
from omtwarp.mesh.shapes import icosphere
from omtwarp.metrics import measure_triangles
from omtwarp.transport.cost import transport_cost
from omtwarp.transport.flow import optimal_transport


def test_it_ends_where_the_default_ends_with_its_areas_and_takes_longer(device):
    surface = turned(icosphere(14))
    best = surface.vertices
    x, initial = pushed_north(best, 0.5), twisted(best, 0.5)
    lowest, highest = (transport_cost(surface, y, start=x) for y in (best, initial))
    plain = optimal_transport(surface, initial, start=x, scheme="plain", iterations=300, device=device)
    default = optimal_transport(surface, initial, start=x, device=device)

    def needed(flow, part: float = 0.01) -> int:
        return next(r["iteration"] for r in flow.history if r["cost"] < lowest + part * (highest - lowest))

    assert needed(plain) > 2 * needed(default)
    costs = [record["cost"] for record in plain.history]
    assert costs == sorted(costs, reverse=True)
    # A cost below that of the optimal map would have been paid for with area.
    assert costs[-1] > lowest - 0.002 * (highest - lowest)
    assert measure_triangles(surface.vertices, surface.faces, plain.sphere).area["sphere"] < 2.002
    assert count_flips(plain.sphere, surface.faces) == 0
