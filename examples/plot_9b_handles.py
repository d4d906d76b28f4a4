"""
Surfaces with handles
=====================

A surface with one handle goes to a flat torus, and a picture that repeats both ways closes up on it. A surface with
more is cut open along short loops, one for each handle, and goes to the sphere.
"""

import itertools

import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.render.subject import torus_view
from omtwarp.texturing import rasterize


def mug(points):
    """Signed distance to a mug, about: a thick cylinder, hollowed from above, with half a ring for a handle."""
    x, y, z = points.T
    around = np.hypot(x, y)
    cup = np.maximum(np.maximum(around - 0.7, np.abs(z) - 0.7), -np.maximum(around - 0.5, -0.5 - z))
    handle = np.maximum(np.hypot(np.hypot(x - 0.75, z) - 0.42, y) - 0.14, 0.6 - around)
    return -0.06 * np.logaddexp(-cup / 0.06, -handle / 0.06)


# %%
# One handle: circles of equal size cover the mug inside and outside, as they cover the torus.

result = omtwarp.map_surface(omtwarp.shapes.implicit_surface(mug, [-1, -1, -1], [1.6, 1, 1], cell=0.14))
print(result, result.certificate)
print(result.distortion())

# %%
# Two handles, each cut along one loop, through its hole as limbs would be thin otherwise: the picture is continuous
# everywhere but across the cuts. Their two sides are black; on the sphere they surround the small filling.

pretzel = omtwarp.shapes.rings(2, tube=0.45, cell=0.42)
cut = omtwarp.map_surface(pretzel)
print(cut, f"{len(cut.loop_pairs)} cuts of {len(cut.loops) // len(cut.loop_pairs) // 2} edges on average")


def with_cuts(picture):
    """Draw the loops on a picture of the sphere: arcs between the images of their vertices, 0.04 radians wide."""
    height, width = picture.shape[:2]
    longitude = (np.arange(width) + 0.5) / width * 2.0 * np.pi - np.pi
    latitude = np.pi / 2.0 - (np.arange(height) + 0.5) / height * np.pi
    east, up = np.meshgrid(longitude, latitude)
    texels = np.stack([np.cos(up) * np.cos(east), np.cos(up) * np.sin(east), np.sin(up)], axis=-1)
    ends = [0, *cut.loop_ends]
    drawn = picture.copy()
    for begin, end in itertools.pairwise(ends):
        loop = cut.sphere[cut.loops[begin:end]]
        for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            points = a + np.linspace(0.0, 1.0, 9)[:, None] * (b - a)
            points /= np.linalg.norm(points, axis=1)[:, None]
            drawn[(texels @ points.T).max(axis=-1) > np.cos(0.02)] = 0
    return drawn


puzzle = with_cuts(rasterize("puzzle", 1024))
mug_view = torus_view(result)
mug_view.up = "z"
sheet(
    [
        mug_view,
        torus_view(result, on="torus"),
        SurfaceView(cut.vertices, cut.faces, image=puzzle, sphere=cut.sphere),
        SurfaceView(cut.sphere, cut.faces, image=puzzle, sphere=cut.sphere),
    ],
    captions=["a mug", "its torus", "a pretzel cut open", "its sphere"],
    columns=4,
    size=(400, 380),
)
