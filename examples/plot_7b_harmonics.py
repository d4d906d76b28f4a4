"""
A shape in a few numbers
========================

A map to the sphere turns a surface into three functions on the sphere, which are expanded in spherical harmonics.
Truncated at a low degree, the sum is a smooth version of the surface; the terms left out are the error.
"""

import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.shape_analysis import expand

surface = omtwarp.shapes.hippocampus(seed=2, face_count=1500)
result = omtwarp.map_to_sphere(surface, until="moser")
turned = omtwarp.align(result)  # the longest axis of the shape to +x, the shortest to the north pole
shape = expand(turned.sphere, result.vertices, degree=12, faces=result.faces)

# %%
# The root mean square distance of a truncated surface is the power of the degrees left out.

for degree in (1, 3, 6, 12):
    missing = np.sqrt(shape.power()[degree + 1 :].sum() / (4 * np.pi))
    print(f"degree {degree:2}: {3 * (degree + 1) ** 2:3} numbers, {missing:.4f} off the sum up to degree 12")

# %%
# Degree 1 is an ellipsoid.

views = []
for degree in (1, 3, 6):
    smooth = shape.truncated(degree).surface(16)
    views.append(SurfaceView(smooth.vertices, smooth.faces, color="#c9b79c"))
views.append(SurfaceView(surface.vertices, surface.faces, color="#9cb3c9"))
sheet(views, captions=["degree 1", "degree 3", "degree 6", "the surface"], columns=2, size=(400, 320))
