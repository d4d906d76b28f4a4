"""
Several shapes on one sphere
============================

Shapes that are mapped to the same sphere can be compared point by point: here three blobs are brought to one mesh,
averaged, and each is coloured by how far it is from the mean.
"""

import numpy as np

import omtwarp
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.texturing import bake_vertex_values, sample

shapes = [omtwarp.shapes.blob(seed=seed, amplitude=0.22, degree=4, sphere=2000) for seed in (1, 2, 3)]
maps = [omtwarp.map_to_sphere(shape, refine="balanced") for shape in shapes]

# %%
# A map to the sphere is free up to a rotation. Each shape is turned so that its points lie as near as they can to the
# first one's (Kabsch's rotation between the maps, weighted by area, found from where the surfaces point).


def rotation_to(target, moving):
    """Rotation that brings the unit vectors ``moving`` nearest to ``target``, both [N, 3]."""
    u, _, vt = np.linalg.svd(target.T @ moving)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


turned = []
for made in maps:
    outward = made.vertices - made.vertices.mean(axis=0)
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    turned.append(made.sphere @ rotation_to(outward, made.sphere).T)

# %%
# One grid for all: the vertices of a geodesic sphere, looked up in the coordinates of each shape, which are baked over
# the sphere like any other numbers at vertices.

grid = omtwarp.shapes.icosphere(16)
common = []
for made, sphere in zip(maps, turned, strict=True):
    baked = bake_vertex_values(made.vertices, sphere, made.faces, "octahedral", size=512)
    common.append(sample(baked, grid.vertices, "octahedral"))
mean = np.mean(common, axis=0)
largest = max(np.linalg.norm(points - mean, axis=1).max() for points in common)

views = [
    SurfaceView(
        points,
        grid.faces,
        scalar=ScalarField(np.linalg.norm(points - mean, axis=1), "viridis", (0.0, largest), "distance"),
    )
    for points in common
]
sheet(
    [*views, SurfaceView(mean, grid.faces, color="#c9b79c")],
    captions=["first", "second", "third", "mean"],
    columns=2,
    size=(400, 340),
    color_bar=False,
)
