"""
Parts side by side
==================

An assembly of several parts on one sphere: each part takes a spherical cap, with an area in proportion to its own, so
that one picture covers all of them. Closed parts are slit open first.
"""

import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

blob = omtwarp.shapes.blob(seed=1, sphere=640)
limbs = omtwarp.shapes.limbs(length=0.8, sharpness=6.0, sphere=640)
whole = omtwarp.shapes.blob(seed=3, sphere=640)
kept = (whole.vertices[whole.faces, 2] > -0.3).all(axis=1)
used, faces = np.unique(whole.faces[kept], return_inverse=True)
parts = [
    (blob.vertices, blob.faces),
    (limbs.vertices + [0.0, 3.2, 0.0], limbs.faces),
    (1.3 * whole.vertices[used] + [0.0, 6.8, 0.0], faces.reshape(-1, 3)),
]
first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
assembly = (
    np.concatenate([vertices for vertices, _ in parts]),
    np.concatenate([faces + start for (_, faces), start in zip(parts, first, strict=False)]),
)

together = omtwarp.map_surface(assembly, together=True)
print(together, together.certificate)
print("shares of the sphere:", together.cap_shares.round(3))

globe = rasterize("globe", 1024)
sheet(
    [
        SurfaceView(together.vertices, together.faces, image=globe, sphere=together.sphere, up="z", front="+x"),
        SurfaceView(together.sphere, together.faces, image=globe, sphere=together.sphere, up="z", front="+x"),
        SurfaceView(together.sphere, together.faces, image=globe, sphere=together.sphere, up="z", front="-x"),
    ],
    captions=["three parts", "their caps on one sphere", "the other side"],
    columns=3,
    size=(500, 420),
)
