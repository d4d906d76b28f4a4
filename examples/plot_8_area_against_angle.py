"""
Area against angle
==================

No map keeps both, unless the surface is a sphere. From the optimal map refinement goes on with a weight of area against
angle, and never flips a triangle, whatever the weight.
"""

# sphinx_gallery_thumbnail_number = 2
import matplotlib.pyplot as plt

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

mesh = omtwarp.shapes.limbs(length=1.2, sharpness=9.0, sphere=2000)
transported = omtwarp.map_to_sphere(mesh, until="omt")
surface = omtwarp.Surface(transported.vertices, transported.faces)

weights = [100.0, 10.0, 3.0, 1.0]  # beyond 10 the areas around vertices count, so that the mesh keeps its freedom
maps = []
sphere = transported.transported
for weight in weights:
    sphere = omtwarp.refine_map(surface, sphere, weight=weight).sphere
    maps.append(sphere)

figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
measured = [omtwarp.distortion(surface, sphere) for sphere in maps]
axis.plot([m.area["surface"] for m in measured], [m.angle["surface"] for m in measured], "o-")
for weight, m in zip(weights, measured, strict=True):
    axis.annotate(f"  {weight:g}", (m.area["surface"], m.angle["surface"]))
axis.set(xlabel="area distortion (2 is perfect)", ylabel="angle distortion (2 is perfect)")
axis.set_title("weight of area against angle", fontsize=10)
plt.show()

# %%

circles = rasterize("circles", 1024)
sheet(
    [SurfaceView(mesh.vertices, mesh.faces, image=circles, sphere=maps[k]) for k in (0, 1, 3)],
    captions=[f"weight {weights[k]:g}" for k in (0, 1, 3)],
    columns=3,
    size=(420, 360),
)
