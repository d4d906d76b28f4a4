"""
Starts of other kinds, and repair of flipped triangles
======================================================

Transport may begin at any map without a flipped triangle. Four ways to one, for a body with thin limbs: barycentric
maps, the conformal map centred by a Möbius transformation, the hierarchical embedding that takes over where the
conformal map fails, and the repair of a map with flipped triangles.
"""

import numpy as np

import omtwarp
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.texturing import rasterize

surface = omtwarp.shapes.limbs(length=1.0, sharpness=8.0, sphere=2000)
circles = rasterize("circles", 1024)

# %%
# Every vertex at the mean of its neighbours (Tutte), or at a mean with weights from the triangles' angles (mean value);
# the conformal map, which keeps angles and shrinks the limbs, so that circles on them are large; and the hierarchical
# embedding, which places each vertex at a minimum of distortion, areas first.

starts = {
    "Tutte": omtwarp.barycentric_map(surface).sphere,
    "mean value": omtwarp.barycentric_map(surface, weights="mean-value").sphere,
    "conformal": omtwarp.conformal_map(surface).sphere,
    "hierarchical": omtwarp.hierarchical_embedding(surface).sphere,
}
for name, sphere in starts.items():
    print(f"{name:14s} {omtwarp.distortion(surface, sphere)}, one to one: {omtwarp.certify(surface, sphere).bijective}")
sheet(
    [SurfaceView(surface.vertices, surface.faces, image=circles, sphere=sphere) for sphere in starts.values()],
    captions=list(starts),
    columns=4,
    size=(300, 300),
)

# %%
# Möbius transformations keep angles and decide where the room is. This conformal map has been moved to one side;
# centring brings it back, so that no half of the surface is crowded into a corner of the sphere.

conformal = starts["conformal"]
pole = np.array([0.0, 0.0, 1.0])
height = conformal @ pole
away = np.column_stack([conformal[:, :2], np.sinh(1.0) + np.cosh(1.0) * height])  # a boost of rapidity 1
away /= (np.cosh(1.0) + np.sinh(1.0) * height)[:, None]
centred = omtwarp.mobius_centring(surface, away).sphere
sheet(
    [
        SurfaceView(sphere, surface.faces, scalar=ScalarField(surface.vertices[:, 2], label="height on the surface"),
                    up="z", edges=True)
        for sphere in (away, centred)
    ],
    captions=["moved to the north", "centred"],
    size=(380, 360),
)  # fmt: skip

# %%
# Noise in a part of the map leaves flipped triangles, which are red here; :func:`omtwarp.certify` counts them exactly.
# Untangling moves as few vertices as it can until none is left.

start = starts["hierarchical"]
region = (start[:, 1] < -0.85)[:, None]
tangled = start + 0.08 * region * np.random.default_rng(1).standard_normal(start.shape)
tangled /= np.linalg.norm(tangled, axis=1)[:, None]
untangled = omtwarp.untangle(surface, tangled).sphere

views = []
for sphere in (tangled, untangled):
    flipped = np.linalg.det(sphere[surface.faces]) <= 0.0
    faces = np.where(flipped[:, None], surface.faces[:, ::-1], surface.faces)  # so that flipped ones face outwards
    colors = np.where(flipped[:, None], [0.75, 0.1, 0.1], [0.86, 0.87, 0.9])
    name = f"{omtwarp.certify(surface, sphere).flips} flipped triangles"
    views.append(SurfaceView(sphere, faces, colors=colors, edges=True, smooth=False, up="z", front="-y", caption=name))
sheet(views, views="front", size=(380, 360))
