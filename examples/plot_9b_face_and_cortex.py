"""
A face and a cortex
===================

A face scan has one boundary: it goes to the hemisphere, and half a globe is drawn on it. A cortex has a medial wall,
the hole where the other half of the brain was: filled, it takes little of the sphere, and the rest has the whole globe.
"""

import numpy as np

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

# %%
# A face as a height over an oval: brow, eye sockets, nose, lips and chin.

ball = omtwarp.shapes.uv_sphere(63, 80)
north = (ball.vertices[ball.faces, 2] > -1e-9).all(axis=1)
used, faces = np.unique(ball.faces[north], return_inverse=True)
longitude = np.arctan2(ball.vertices[used, 1], ball.vertices[used, 0])
radius = np.arccos(np.clip(ball.vertices[used, 2], 0.0, 1.0)) / (0.5 * np.pi)
x, y = 0.95 * radius * np.cos(longitude), radius * np.sin(longitude)


def bump(cx, cy, wide, high):
    return np.exp(-(((x - cx) / wide) ** 2) - ((y - cy) / high) ** 2)


height = 0.75 * np.sqrt(1.05 - x**2 - 0.8 * y**2) + 0.36 * bump(0.0, -0.02, 0.13, 0.22)
height += 0.12 * bump(0.0, -0.12, 0.2, 0.08) + 0.07 * bump(0.0, 0.36, 0.5, 0.1)
height -= 0.16 * (bump(0.32, 0.18, 0.17, 0.1) + bump(-0.32, 0.18, 0.17, 0.1))
height += 0.07 * (bump(0.0, -0.38, 0.22, 0.05) + bump(0.0, -0.5, 0.18, 0.06)) + 0.08 * bump(0.0, -0.78, 0.2, 0.12)
half = omtwarp.map_surface((np.stack([0.85 * x, 1.1 * y, height], axis=1), faces.reshape(-1, 3)))
print(half)

# %%
# A wrinkled ball, flat on the side where the other half would be, with a hole there.

wrinkled = omtwarp.shapes.blob(seed=8, amplitude=0.1, degree=16, sphere=5120)
points = wrinkled.vertices * [1.0, 1.3, 1.0]
points[:, 0] = np.where(points[:, 0] > 0.0, 0.25 * np.tanh(points[:, 0] / 0.25), points[:, 0])
direction = wrinkled.vertices / np.linalg.norm(wrinkled.vertices, axis=1)[:, None]
hole = (direction[wrinkled.faces, 0] > 0.85).all(axis=1)
used, faces = np.unique(wrinkled.faces[~hole], return_inverse=True)
cortex = omtwarp.map_surface((points[used], faces.reshape(-1, 3)), domain="sphere", fill_area="small")
print(cortex)

# %%
# The wall is drawn in grey on its patch of the sphere: texels that lie in one of the filling's triangles.

globe = rasterize("globe", 1024)
wall = cortex.filled_sphere[cortex.filled_faces[cortex.filled_loop >= 0]]  # corners of triangles, [K, 3, 3]
east, up = np.meshgrid(
    (np.arange(1024) + 0.5) / 1024 * 2.0 * np.pi - np.pi, np.pi / 2.0 - (np.arange(512) + 0.5) / 512 * np.pi
)
texels = np.stack([np.cos(up) * np.cos(east), np.cos(up) * np.sin(east), np.sin(up)], axis=-1)
near = texels @ wall.mean(axis=(0, 1)) > 0.95
sides = np.cross(wall, np.roll(wall, -1, axis=1))  # normals of the planes through the centre and a side
sides /= np.linalg.norm(sides, axis=-1, keepdims=True)
inside = ((texels[near] @ sides.reshape(-1, 3).T).reshape(-1, len(wall), 3) > -1e-3).all(axis=2).any(axis=1)
walled = globe.copy()
walled[near] = np.where(inside[:, None], 165, walled[near])

face = SurfaceView(half.vertices, half.faces, image=globe, sphere=half.sphere, up="y", front="+z")
sheet(
    [
        omtwarp.preview(face, views=(-18, 6), size=(400, 380)),
        SurfaceView(half.sphere, half.faces, image=globe, sphere=half.sphere, up="z"),
        SurfaceView(
            cortex.filled_vertices, cortex.filled_faces, image=walled, sphere=cortex.filled_sphere, up="z", front="+x"
        ),
        SurfaceView(cortex.vertices, cortex.faces, image=globe, sphere=cortex.sphere, up="z", front="-x"),
    ],
    captions=["a face", "its hemisphere", "the medial wall", "the cortex"],
    columns=4,
    size=(400, 380),
)
