"""
A film of the map
=================

:func:`omtwarp.film` writes the map as it flows from conformal to optimal, and the surface as it becomes its sphere.
Here are frames of one, from left to right: the circles reach equal areas first, then the surface is blown up to the
sphere that it was mapped to.
"""

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

import omtwarp
from omtwarp.render import sheet

mesh = omtwarp.shapes.limbs(length=0.8, sharpness=6.0, sphere=2000)
result = omtwarp.map_to_sphere(mesh)
with tempfile.TemporaryDirectory() as folder:
    path = omtwarp.film(result, Path(folder) / "flow.webp", size=(300, 300), seconds=2, fps=6, captions=False)
    frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(Image.open(path))]

shown = np.linspace(0, len(frames) - 1, 5).round().astype(int)
sheet([frames[k] for k in shown], captions=["conformal", "", "", "", "the sphere"], columns=5, size=(300, 300))
