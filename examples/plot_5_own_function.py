"""
A function of your own on the sphere
====================================

Any function of the direction can be baked into a texture: a formula, a picture, or numbers at the vertices.
"""

import numpy as np

import omtwarp
from omtwarp.colors import colormap_table
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.texturing import bake, bake_vertex_values, sample

mesh = omtwarp.shapes.blob(seed=8, amplitude=0.3, sphere=2880)
result = omtwarp.map_to_sphere(mesh)


# %%
# A function from unit vectors [N, 3] to colours [N, 3]. It is called for many directions at once.


def bands(directions):
    x, y, z = directions.T
    wave = np.sin(9 * z + 2 * np.sin(3 * np.arctan2(y, x)) * (1 - z**2))
    share = (0.5 + 0.5 * np.tanh(6 * wave))[:, None]
    return share * [0.96, 0.85, 0.60] + (1 - share) * [0.13, 0.33, 0.45]


picture = bake(bands, "equirectangular", size=1024)
sheet(
    [
        SurfaceView(result.vertices, result.faces, image=picture, sphere=result.sphere),
        SurfaceView(result.sphere, result.faces, image=picture, sphere=result.sphere, up="z"),
    ],
    captions=["on the surface", "on the sphere"],
    size=(440, 400),
)

# %%
# Numbers at the vertices take the other way: height over the middle of the blob, baked into a map of it, and read off
# that map again at the vertices. Between texels and triangles little is lost.

height = np.linalg.norm(result.vertices - result.vertices.mean(axis=0), axis=1)
baked = bake_vertex_values(height, result.sphere, result.faces, size=1024)
back = sample(baked, result.sphere)[:, 0]
print(f"largest difference {np.abs(back - height).max():.1e} of {np.ptp(height):.2f}")

share = (baked[..., 0] - height.min()) / np.ptp(height)
colours = colormap_table("viridis")[np.clip(255 * share, 0, 255).astype(int)]
sheet(
    [
        SurfaceView(result.vertices, result.faces, scalar=ScalarField(back, "viridis", label="height")),
        SurfaceView(result.sphere, result.faces, image=colours, sphere=result.sphere, up="z"),
    ],
    captions=["read off again", "the map of it, on the sphere"],
    size=(440, 400),
)
