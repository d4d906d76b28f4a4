"""
Textures and atlases
====================

Four patterns on the sphere, and three ways of laying the sphere out on a picture.
"""

import matplotlib.pyplot as plt

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

mesh = omtwarp.shapes.limbs(length=1.0, sharpness=7.0, sphere=2880)
result = omtwarp.map_to_sphere(mesh)

# %%
# The patterns of the paper's section 5, and a checker. They have no seam and no pole: each pixel looks its direction
# up.

patterns = ["circles", "puzzle", "globe", "checker"]
sheet(
    [
        SurfaceView(result.vertices, result.faces, image=rasterize(name, 1024), sphere=result.sphere)
        for name in patterns
    ],
    captions=patterns,
    columns=2,
    size=(480, 400),
)

# %%
# A file needs a texture, and so a layout with cuts. The cube map is the default; the octahedral map is one square; the
# equirectangular one is what most pictures of the whole sphere come in. Triangles are cut along the seams, so that none
# is smeared over the picture, and the mesh's own vertices stay the first ones, in their order.

figure, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
for axis, atlas in zip(axes, ("cube", "octahedral", "equirectangular"), strict=True):
    textured = omtwarp.texture(result, pattern="globe", atlas=atlas, size=512)
    height, width = textured.image.shape[:2]
    axis.imshow(textured.image)
    faces, vertex, uv = textured.split()
    axis.triplot(uv[:, 0] * width, (1 - uv[:, 1]) * height, faces, color="white", lw=0.15, alpha=0.7)
    axis.set_title(f"{atlas}: {len(vertex) - len(result.vertices)} vertices more", fontsize=10)
    axis.axis("off")
plt.show()
