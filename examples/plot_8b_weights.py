"""
More of the sphere for what matters
===================================

A map keeps a measure; area is the default. :func:`omtwarp.weighted_surface` multiplies every triangle's area by a
weight, so that a region gets more of the sphere, and of any texture on it.
"""

import numpy as np

import omtwarp
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.texturing import rasterize

mesh = omtwarp.shapes.blob(seed=5, amplitude=0.3, sphere=2000)
front = -mesh.vertices[:, 1] / np.linalg.norm(mesh.vertices, axis=1)  # 1 where the surface faces the viewer
weights = 1.0 + 3.0 / (1.0 + np.exp(-30.0 * (front - 0.8)))  # four times as much in front

plain = omtwarp.map_to_sphere(mesh)
weighted = omtwarp.map_to_sphere(mesh, weights=weights)

# %%
# The measure that the second map keeps is that of the weighted surface: its share of the sphere is the region's share
# of the map.

measure = omtwarp.weighted_surface(mesh, weights)
region = (front > 0.8)[mesh.faces].all(axis=1)


def share(areas):
    """Return the region's share of the whole, in per cent."""
    return 100.0 * areas[region].sum() / areas.sum()


print(f"the region: {share(mesh.face_areas):.1f} % of the area, {share(measure.face_areas):.1f} % of the measure")
for name, result in (("area", plain), ("weights", weighted)):
    image = omtwarp.Surface(result.sphere, result.faces)
    print(f"mapped by {name}: {share(image.face_areas):.1f} % of the sphere")

# %%
# Where the weight is large, circles are small: more of the pattern lies there.

circles = rasterize("circles", 1024)
weight = ScalarField(weights, label="weight")
sheet(
    [
        SurfaceView(mesh.vertices, mesh.faces, scalar=weight, up="z", front="-y"),
        SurfaceView(mesh.vertices, mesh.faces, image=circles, sphere=plain.sphere, up="z", front="-y"),
        SurfaceView(mesh.vertices, mesh.faces, image=circles, sphere=weighted.sphere, up="z", front="-y"),
    ],
    captions=["weights", "mapped by area", "mapped by weights"],
    columns=3,
    views="front",
    size=(380, 340),
)
