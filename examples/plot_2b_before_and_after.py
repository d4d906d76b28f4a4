"""
Circles before and after transport
==================================

Moser's flow makes areas nearly right, with no other criterion. The optimal map keeps the areas around
vertices and, of all maps that do, moves mass the least. Circles on the sphere, pulled back, show the difference.
"""

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

circles = rasterize("circles", 2048)


def before_and_after(mesh):
    """Views of a mesh through Moser's map and through the optimal map."""
    result = omtwarp.map_to_sphere(mesh)
    for stage in ("moser", "sphere"):
        print(f"{stage:8s} {result.distortion(stage)}")
    maps = (result.moser, result.sphere)
    return [SurfaceView(result.vertices, result.faces, image=circles, sphere=sphere) for sphere in maps]


# %%
# A creature with legs, ears and a tail. Where a limb has few vertices around it, as at the root of the tail, the
# outlines stay jagged in both maps: there the triangles are too large for how fast the map changes.

sheet(
    before_and_after(omtwarp.shapes.demo_shape(8000)),
    captions=["Moser's map", "optimal map"],
    size=(640, 600),
    up="z",
    front="-y",
    views=(40.0, 15.0),
)

# %%
# A bent tube that thins towards one end, as a hippocampus does.

sheet(
    before_and_after(omtwarp.shapes.tube(3.0, bend=1.8, taper=0.6, face_count=6000)),
    captions=["Moser's map", "optimal map"],
    size=(640, 320),
)
