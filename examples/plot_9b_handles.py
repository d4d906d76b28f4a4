"""
Surfaces with handles
=====================

A surface with one handle goes to a flat torus, and a picture that repeats both ways closes up on it. A surface with
more is cut open along short loops, one for each handle, and goes to the sphere.
"""

import numpy as np
from scipy.spatial import cKDTree

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.render.subject import torus_view
from omtwarp.texturing import rasterize


def larger(a, b):
    """The larger of two distances, rounded off where they are equal: of two bodies, what they share."""
    return 0.05 * np.logaddexp(a / 0.05, b / 0.05)


def mug(points):
    """Signed distance to a mug, about: a thick cylinder, hollowed from above, with half a ring for a handle."""
    x, y, z = points.T
    around = np.hypot(x, y)
    cup = larger(larger(around - 0.7, np.abs(z) - 0.7), -larger(around - 0.5, -0.5 - z))
    handle = larger(np.hypot(np.hypot(x - 0.75, z) - 0.42, y) - 0.14, 0.6 - around)
    return -larger(-cup, -handle)


# %%
# One handle: circles of equal size cover the mug inside and outside, as they cover the torus.

result = omtwarp.map_surface(omtwarp.shapes.implicit_surface(mug, [-1, -1, -1], [1.6, 1, 1], cell=0.08))
print(result, result.certificate)
print(result.distortion())

# %%
# Two handles, each cut along the shortest loop, which runs through its hole: the picture is continuous everywhere but
# across the cuts, which are red. For the map to the sphere both sides of a cut are closed, in grey, and take little of
# it. The map is turned to the pretzel's own axes, so that both are seen from the same side.

cut = omtwarp.map_surface(omtwarp.shapes.rings(2, tube=0.65, cell=0.15))
cut = omtwarp.align(cut).turned(cut)
print(cut, f"{len(cut.loop_pairs)} cuts of {len(cut.loops) // len(cut.loop_pairs) // 2} edges on average")

# %%
# Texels in what closes the cuts get no data from the surface. The cuts are arcs between the images of their vertices,
# painted 0.035 radians wide.

texels = omtwarp.resample(cut, "equiangular:512x1024", method="nearest")
after = np.concatenate([np.roll(loop, -1) for loop in np.split(cut.loops, cut.loop_ends[:-1])])
begin, end = cut.sphere[cut.loops], cut.sphere[after]
arcs = begin[:, None] + np.linspace(0.0, 1.0, 9)[:, None] * (end - begin)[:, None]
apart, _ = cKDTree(arcs.reshape(-1, 3)).query(texels.target.grid.points, distance_upper_bound=0.035)

puzzle = rasterize("puzzle", 1024)
puzzle[np.isfinite(apart).reshape(512, 1024)] = 200, 20, 30
puzzle[texels.empty.reshape(512, 1024)] = 165

mug_view = torus_view(result)
mug_view.up = "z"
closed = cut.closed()
pretzel, sphere = (
    SurfaceView(points, closed.faces, image=puzzle, sphere=closed.sphere, up="z", front="-y")
    for points in (closed.vertices, closed.sphere)
)
sheet(
    [
        omtwarp.preview(mug_view, views=(-22, 25), size=(400, 380)),
        torus_view(result, on="torus"),
        omtwarp.preview(pretzel, views=(0, 52), size=(400, 380)),
        omtwarp.preview(sphere, views=(0, 52), size=(400, 380)),
    ],
    captions=["a mug", "its torus", "a pretzel, cut and closed", "its sphere"],
    columns=4,
    size=(400, 380),
)
