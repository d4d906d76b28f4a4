"""
Own texture coordinates, materials and bakes
============================================

A mesh gets texture coordinates through its map, without a triangle being cut; patterns, ambient occlusion and curvature
are baked into them; and a texture is carried over to another shape.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import omtwarp
from omtwarp.render import sheet

surface = omtwarp.shapes.blob(seed=3, sphere=2880)
result = omtwarp.map_to_sphere(surface, until="moser")

# %%
# The six sides of a cube, each with the triangles whose centroids it contains.

mesh = omtwarp.unwrap_uv(result)
figure, axis = plt.subplots(figsize=(5, 5), layout="constrained")
flat = mesh.uv.reshape(-1, 2)
axis.triplot(flat[:, 0], flat[:, 1], np.arange(len(flat)).reshape(-1, 3), lw=0.3, color="#35507a")
axis.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel="u", ylabel="v")
plt.show()

# %%
# Two materials, the upper half and the lower, and the puzzle over both of them: in the mesh's own coordinates, a
# picture for each. :func:`omtwarp.read_painted_mesh` reads such meshes from files of other programs. Ambient occlusion
# goes to a slot of its own in the material, where viewers of glTF find it; here it is shown as a colour.

halves = (surface.vertices[surface.faces].mean(axis=1)[:, 1] > 0).astype(np.int32)
clay, jade = omtwarp.Material("clay", (0.75, 0.35, 0.25, 1.0)), omtwarp.Material("jade", (0.15, 0.5, 0.4, 1.0))
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "two.obj"
    omtwarp.PaintedMesh(mesh.vertices, mesh.faces, mesh.uv, (clay, jade), halves).export(file)
    two = omtwarp.read_painted_mesh(file)
over = omtwarp.paint(result, two, pattern="puzzle", keep="over", opacity=0.35, size=512)
baked = omtwarp.paint(result, mesh, bake=["ao"], size=256).materials[0].occlusion_picture
shaded = omtwarp.PaintedMesh(mesh.vertices, mesh.faces, mesh.uv, (omtwarp.Material("occlusion", picture=baked),))
curved = omtwarp.paint(result, mesh, bake=["curvature"], size=512)

# %%
# A texture is carried over to a wider shape with other triangles, by the two maps, aligned.

coarse = omtwarp.shapes.blob(seed=3, sphere=1280)
other = omtwarp.Surface(coarse.vertices * (1.3, 0.9, 1.0), coarse.faces)
carried = omtwarp.transfer_texture(over, result, omtwarp.map_to_sphere(other, until="moser"), size=768)
sheet(
    [over, shaded, curved, carried],
    captions=["a pattern over two materials", "ambient occlusion", "mean curvature", "carried over to another shape"],
    columns=2,
    size=(480, 400),
)
