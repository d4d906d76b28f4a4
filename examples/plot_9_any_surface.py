"""
Surfaces with holes
===================

A surface with a boundary goes to a hemisphere or to the unit disk, its boundary on the rim; or its holes are filled and
it goes to the sphere.
"""

import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

whole = omtwarp.shapes.limbs(length=0.8, sharpness=6.0, sphere=5120)
kept = (whole.vertices[whole.faces, 2] > -0.5).all(axis=1)
used, faces = np.unique(whole.faces[kept], return_inverse=True)
surface = whole.vertices[used], faces.reshape(-1, 3)

# %%
# One boundary loop: the boundary lies on the equator exactly, areas are kept, no triangle is flipped.

half = omtwarp.map_surface(surface)
print(half)

# %%
# The same in the unit disk, by Lambert's equal-area projection.

disk = omtwarp.map_surface(surface, domain="disk")
flat = np.concatenate([disk.disk, np.zeros((len(disk.disk), 1))], axis=1)

# %%
# The hole filled, and its share of the sphere made small.

filled = omtwarp.map_surface(surface, domain="sphere", fill_area="small")
print(filled)

globe = rasterize("globe", 1024)
checker = rasterize("checker", 1024)
sheet(
    [
        SurfaceView(half.vertices, half.faces, image=globe, sphere=half.sphere, up="z"),
        SurfaceView(half.sphere, half.faces, image=globe, sphere=half.sphere, up="z"),
        SurfaceView(flat, disk.faces, image=globe, sphere=disk.sphere, up="y", front="+z"),
        SurfaceView(filled.vertices, filled.faces, image=checker, sphere=filled.sphere, up="z"),
    ],
    captions=["to the hemisphere", "the hemisphere", "the disk", "hole filled small"],
    columns=4,
    size=(400, 380),
)
