"""
Where two groups differ
=======================

Twelve shapes like hippocampi, of which every other one has a bump at the same place. From their maps alone, each with
its own mesh and position, the group's mean is found, how its members vary, and where the two halves differ.
"""

import numpy as np

import omtwarp
from omtwarp.render import ScalarField, SurfaceView, sheet
from omtwarp.shape_analysis import shape_distance, study_group

maps = []
for seed in range(12):
    shape = omtwarp.shapes.hippocampus(
        seed, bump=0.5 * (seed % 2), width=0.4, variation=0.05, face_count=700 + 20 * seed
    )
    maps.append(omtwarp.map_to_sphere(shape, until="moser"))
study = study_group(maps, ["control", "patient"] * 6, grid="ico3", degree=8)

# %%
# Components are numbered by how much of the variance they explain. At every point Student's t compares the groups along
# the mean surface's normal; p is corrected for the number of points.

found = study.effects["group"]
print("variance explained:", np.round(study.components.explained, 2))
print(f"largest t {found.statistic.max():.1f}, smallest p {found.p_values.min():.3f}")
print("distance of the first two:", shape_distance(maps[0], maps[1], degree=8))

# %%
# The mean, coloured by how far patients lie outside controls, and by t; then two standard deviations to either side of
# it along the first component.

mean, faces = study.alignment.mean, study.alignment.faces
reach = np.abs(found.size).max()
views = [
    SurfaceView(mean, faces, scalar=ScalarField(found.size, "coolwarm", (-reach, reach), "outside")),
    SurfaceView(mean, faces, scalar=ScalarField(found.statistic, "viridis", (0.0, found.statistic.max()), "t")),
    *(SurfaceView(study.along(0, away).vertices, faces, color="#c9b79c") for away in (-2.0, 2.0)),
]
captions = ["patients outside controls", "Student's t", "first component, -2 sd", "first component, +2 sd"]
sheet(views, captions=captions, columns=2, size=(400, 320), color_bar=False)
