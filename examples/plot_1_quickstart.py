"""
Map a surface and texture it
============================

A closed surface in, a sphere out: every vertex gets a point on the unit sphere so that areas are preserved and no
triangle is flipped. Whatever is drawn on the sphere can then be carried back to the surface.
"""

import omtwarp

# %%
# A ball with four limbs, made by the package, stands in for a mesh of yours: :func:`omtwarp.read_mesh` reads files, and
# a ``trimesh.Trimesh`` or ``(vertices, faces)`` does as well.

mesh = omtwarp.shapes.limbs(length=1.2, sharpness=9.0, sphere=3920)
result = omtwarp.map_to_sphere(mesh)
print(result.distortion())

# %%
# Area distortion of 2 is perfect; the conformal map, where the way started, is far from it:

print(result.distortion("conformal"))

# %%
# Circles of equal size on the sphere show at a glance what a map does to areas.

textured = omtwarp.texture(result, pattern="circles", size=1536)
omtwarp.preview(textured.trimesh(), size=(900, 640))

# %%
# ``textured.export("limbs.glb")`` writes a file that viewers and modelling programs open, ``result.save("map.npz")``
# the map, and :func:`omtwarp.write_report` a page about it.
