"""
What is wrong with a mesh
=========================

A mesh as it may come from a scanner: a hole, triangles that face inwards, and a crumb beside it.
:func:`omtwarp.check` lists what keeps it from being mapped, and :func:`omtwarp.repair` repairs what needs no new shape.
"""

import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

whole = omtwarp.shapes.blob(seed=3, amplitude=0.4, sphere=1280)
crumb = omtwarp.shapes.icosphere(1)
middle = whole.vertices[whole.faces].mean(axis=1)
middle /= np.linalg.norm(middle, axis=1)[:, None]
hole = middle @ [0.4, -0.9, 0.2] > 0.96
inwards = middle @ [-0.5, -0.8, -0.2] > 0.9
faces = whole.faces.copy()
faces[inwards] = faces[inwards][:, ::-1]
vertices = np.concatenate([whole.vertices, 0.08 * crumb.vertices + [0.9, -0.9, 0.9]])
faces = np.concatenate([faces[~hole], crumb.faces + len(whole.vertices)])

for defect in omtwarp.check((vertices, faces)):
    print(defect)

# %%
# Repair says what it did. No vertex is moved.

repaired = omtwarp.repair((vertices, faces))
print("\n".join(repaired.actions))
print(len(omtwarp.check(repaired)), "defects are left")

result = omtwarp.map_to_sphere((repaired.vertices, repaired.faces))
pale, red = [0.84, 0.85, 0.88], [0.8, 0.25, 0.2]
before = np.concatenate([np.where(inwards[:, None], red, pale)[~hole], np.tile(red, (len(crumb.faces), 1))])
after = np.where(repaired.face_origin[:, None] < 0, [0.2, 0.55, 0.4], pale)
circles = rasterize("circles", 1024)
sheet(
    [
        SurfaceView(vertices, faces, colors=before, edges=True, smooth=False, up="z", front="-y"),
        SurfaceView(repaired.vertices, repaired.faces, colors=after, edges=True, smooth=False, up="z", front="-y"),
        SurfaceView(result.vertices, result.faces, image=circles, sphere=result.sphere, up="z", front="-y"),
    ],
    captions=["a hole, faces inwards, a crumb", "repaired", "mapped"],
    columns=3,
    views="front",
    size=(380, 360),
)
