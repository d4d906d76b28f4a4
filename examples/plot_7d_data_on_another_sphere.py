"""
Data on another sphere
======================

Numbers and labels at the vertices of a map are carried to the vertices or pixels of another sphere: by linear
interpolation, or by the areas in which cells overlap, which keeps integrals.
"""

import numpy as np

import omtwarp
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.spheres import named_grid

surface = omtwarp.shapes.blob(seed=5, amplitude=0.25, degree=4, sphere=2000)
result = omtwarp.map_to_sphere(surface, until="moser")
turned = omtwarp.align(result).sphere
height = np.linalg.norm(result.vertices - result.vertices.mean(axis=0), axis=1)

# %%
# The mean over the sphere changes with linear weights, and is kept by conservative ones.

there = (turned, result.faces)
for method in ("nearest", "barycentric", "conservative"):
    moved = omtwarp.resample(there, "ico3", method=method)
    areas, before = moved.target.grid.areas, moved.source.grid.areas
    change = (moved.apply(height) @ areas) / (height @ before) - 1.0
    print(f"{method:12}: the integral changes by {change:9.2e}")

# %%
# Every target vertex gets the label that overlaps it most.

labels = 1 + (turned @ np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).T).argmax(axis=1)
grid = named_grid("ico3")
carried = omtwarp.resample(there, "ico3", method="conservative")
kept = carried.labels(labels)
print("vertices of each label on the grid:", np.bincount(kept)[1:])

# %%
# The data at the map's vertices and at the 642 of the grid, and the labels there.

limits = (height.min(), height.max())
views = [
    SurfaceView(turned, result.faces, scalar=ScalarField(height, "viridis", limits, "height")),
    SurfaceView(grid.points, grid.faces, scalar=ScalarField(carried.apply(height), "viridis", limits, "height")),
    SurfaceView(grid.points, grid.faces, scalar=ScalarField(kept.astype(float), "viridis", (1.0, 6.0), "label")),
]
sheet(views, captions=["on the map", "on ico3", "labels on ico3"], columns=3, size=(360, 320), color_bar=False)
