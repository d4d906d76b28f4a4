"""
Circles before and after transport
==================================

The conformal map keeps angles, and areas not at all. Moser's flow makes areas nearly right, with no other criterion.
The optimal map keeps the areas around vertices and, of all maps that do, moves mass the least. Circles on the sphere,
pulled back, show the difference.
"""

import numpy as np

import omtwarp
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.texturing import rasterize

circles = rasterize("circles", 2048)


def before_and_after(mesh):
    """Views of a mesh through its conformal map, through Moser's map and through the optimal map; the last two."""
    result = omtwarp.map_to_sphere(mesh)
    moser = omtwarp.map_to_sphere(mesh, until="moser").moser
    maps = (result.conformal, moser, result.sphere)
    for caption, sphere in zip(captions, maps, strict=True):
        print(f"{caption:14s} {omtwarp.distortion(mesh, sphere)}")
    return (
        [SurfaceView(mesh.vertices, mesh.faces, image=circles, sphere=sphere) for sphere in maps],
        moser,
        result.sphere,
    )


captions = ["conformal map", "Moser's map", "optimal map"]


# %%
# A creature with legs, ears and a tail. Where a limb has few vertices around it, as at the root of the tail, the
# outlines stay jagged in both maps: there the triangles are too large for how fast the map changes.

sheet(
    before_and_after(omtwarp.shapes.demo_shape(8000))[0],
    captions=captions,
    size=(480, 480),
    up="z",
    front="-y",
    views=(40.0, 15.0),
)

# %%
# A bent tube that thins towards one end, as a hippocampus does. Moser's map of it is nearly optimal already, and the
# circles look alike. The last picture is their difference: the angle between the two images of every point.

tube = omtwarp.shapes.tube(3.0, bend=1.8, taper=0.6, face_count=6000)
views, moser, optimal = before_and_after(tube)
apart = np.rad2deg(np.arccos(np.clip((moser * optimal).sum(axis=1), -1.0, 1.0)))
sheet(
    [*views, SurfaceView(tube.vertices, tube.faces, scalar=ScalarField(apart, label="degrees"))],
    captions=[*captions, "from Moser's to the optimal map"],
    size=(420, 340),
)
