"""
How transport converges
=======================

The cost M of the paper's equation 6 over the iterations. The start is a sphere twisted about its axis: areas are
preserved, but mass is moved needlessly. The optimal map is known here: it is the identity, and its cost is 0.
"""

import matplotlib.pyplot as plt
import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

surface = omtwarp.shapes.icosphere(16)
start = surface.vertices
x, y, z = start.T
turn = 1.2 * z  # radians
twisted = np.column_stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z])

# %%
# Two ways down. The paper's Algorithms 1 and 2 follow the gradient in V-cycles over the levels of spherical wavelets,
# and end where areas would no longer be kept. The flow on vertices moves these themselves, on all levels at once, each
# wavelet with the step that suits its size. (A map's default ends with Newton's method, :func:`omtwarp.optimal_map`.)

flow_on_vertices = omtwarp.optimal_transport(surface, twisted, start=start)
paper = omtwarp.paper_flow(surface, twisted, start=start, cost="squared", cycles=10)

figure, axis = plt.subplots(figsize=(7.5, 3.6), layout="constrained")
for name, flow in (("the paper's V-cycles", paper), ("on vertices", flow_on_vertices)):
    costs = [entry["cost"] for entry in flow.history]
    axis.semilogy(costs, label=f"{name}: {costs[-1]:.1e} after {len(costs) - 1} iterations")
axis.set(xlabel="iteration", ylabel="transport cost M")
axis.legend(frameon=False)
plt.show()

# %%
# Before, and after.

circles = rasterize("circles", 1024)
sheet(
    [
        SurfaceView(surface.vertices, surface.faces, image=circles, sphere=sphere, up="z")
        for sphere in (twisted, flow_on_vertices.sphere)
    ],
    captions=["twisted", "optimal"],
    size=(400, 380),
)

# %%
# How far from the optimum a map is can be measured without knowing the optimum: :func:`omtwarp.optimality` finds a
# lower bound on the cost of every map that moves the same mass, and :func:`omtwarp.map_optimality` does so for the
# stages of a result. Here a map that is twisted by a few degrees before Moser's flow is compared with Moser's map and
# with the optimal one.


def twist(points, radians):
    """Turn points about the z axis by an angle that grows with their height."""
    x, y, z = points.T
    return np.column_stack([
        x * np.cos(radians * z) - y * np.sin(radians * z), x * np.sin(radians * z) + y * np.cos(radians * z), z,
    ])  # fmt: skip


blob = omtwarp.shapes.blob(seed=3, amplitude=0.4, sphere=1280)
result = omtwarp.map_to_sphere(blob)
moser = omtwarp.moser_map(blob, result.conformal).sphere
twisted = omtwarp.moser_map(blob, twist(result.conformal, 0.1)).sphere
measured = {
    "Moser, twisted": (twisted, omtwarp.optimality(blob, twisted, start=result.conformal)),
    "Moser": (moser, omtwarp.optimality(blob, moser, start=result.conformal)),
    "optimal": (result.sphere, omtwarp.map_optimality(result)),
}
for name, (sphere, found) in measured.items():
    moved = omtwarp.transport_cost(blob, sphere, start=result.conformal, cost="geodesic") / (4.0 * np.pi)
    print(f"{name:14s} {found}, moved by {moved:.3f} radians in the mean")

figure, axis = plt.subplots(figsize=(7.5, 2.2), layout="constrained")
gaps = [100.0 * found.gap for _, found in measured.values()]
bars = axis.barh(list(measured), gaps, color=["#9aa5b1", "#9aa5b1", "#1f6f78"])
axis.bar_label(bars, [f"{gap:.2g} %" for gap in gaps], padding=4)
axis.set(xscale="log", xlabel="cost above the lower bound, per cent", xlim=(min(gaps) / 2.0, max(gaps) * 4.0))
axis.invert_yaxis()
plt.show()
