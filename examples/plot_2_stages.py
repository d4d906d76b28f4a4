"""
What each stage does
====================

The conformal map keeps angles and loses areas. Moser's flow makes the areas right. Of all maps that keep the areas
around vertices, the optimal map then moves mass the least; the default ends there. Refinement, where it is asked for,
goes on towards less distortion.
"""

import matplotlib.pyplot as plt
import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

mesh = omtwarp.shapes.blob(seed=3, amplitude=0.4, sphere=5120)
result = omtwarp.map_to_sphere(mesh, refine="balanced")

stages = {
    "conformal": result.conformal,
    "Moser": omtwarp.map_to_sphere(mesh, until="moser").sphere,
    "optimal": result.transported,
    "refined, balanced": result.sphere,
}
for name, sphere in stages.items():
    print(f"{name:18s} {omtwarp.distortion(mesh, sphere)}")

# %%
# The same circles through the four maps.

circles = rasterize("circles", 1024)
sheet(
    [SurfaceView(result.vertices, result.faces, image=circles, sphere=sphere) for sphere in stages.values()],
    captions=list(stages),
    columns=2,
    size=(420, 380),
)

# %%
# How much of the surface has which ratio of areas, sphere to surface. The paper's figure 5 is of this kind.

weights = np.full(len(result.faces), 1 / len(result.faces))
figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for name, sphere in stages.items():
    measured = omtwarp.distortion(mesh, sphere)
    angle = np.exp(np.arccosh(measured.face_angle / 2))  # larger over smaller singular value
    axes[0].hist(
        np.log2(measured.area_ratio), bins=80, range=(-2, 2), weights=weights, histtype="step", lw=1.6, label=name
    )
    axes[1].hist(angle, bins=80, range=(1, 3), weights=weights, histtype="step", lw=1.6)
axes[0].set(xlabel="log₂ of the area ratio", ylabel="share of the triangles")
axes[1].set(xlabel="ratio of the singular values")
axes[0].legend(frameon=False)
plt.show()
