"""
Several shapes on one sphere
============================

Shapes that are mapped to the same sphere can be compared point by point: here three blobs are brought to one mesh,
averaged, and each is coloured by how far it is from the mean.
"""

import numpy as np

import omtwarp
from omtwarp.alignment import procrustes_mean
from omtwarp.render import ScalarField, SurfaceView, sheet

shapes = [omtwarp.shapes.blob(seed=seed, amplitude=0.22, degree=4, sphere=2000) for seed in (1, 2, 3)]
maps = [omtwarp.map_to_sphere(shape, refine="balanced") for shape in shapes]

# %%
# A map to the sphere is free up to a rotation. Each sphere is turned to where the shape's features, such as the
# distance from its centre, agree best with the group's mean. Then all surfaces are resampled on one geodesic sphere,
# with barycentric weights, and superposed.

group = procrustes_mean(maps, grid="ico4")
distances = np.linalg.norm(group.surfaces - group.mean, axis=2)

# %%
# The faces are the same for all, and so a colour is a number per vertex.

views = [
    SurfaceView(points, group.faces, scalar=ScalarField(away, "viridis", (0.0, distances.max()), "distance"))
    for points, away in zip(group.surfaces, distances, strict=True)
]
sheet(
    [*views, SurfaceView(group.mean, group.faces, color="#c9b79c")],
    captions=["first", "second", "third", "mean"],
    columns=2,
    size=(400, 340),
    color_bar=False,
)
