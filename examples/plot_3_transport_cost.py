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
