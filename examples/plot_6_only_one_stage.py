"""
Only one stage
==============

Each stage is a function of its own, for those who have a map already or want no more than one.
"""

import omtwarp
from omtwarp.render import SurfaceView, sheet
from omtwarp.texturing import rasterize

surface = omtwarp.shapes.limbs(length=0.8, sharpness=6.0, sphere=2880)

# %%
# Section 4.1 of the paper alone: a conformal map from one sparse solve, centred by a Möbius transformation.

conformal = omtwarp.conformal_map(surface).sphere

# %%
# Section 4.2 alone: Moser's flow preserves area, from the conformal map or from any other map of yours.

moser = omtwarp.moser_map(surface, conformal).sphere

# %%
# The optimal map alone: it keeps the areas around vertices and, of all maps that do, moves mass the least from where
# the conformal map has it. It begins at any map without flips.

found = omtwarp.optimal_map(surface, moser, start=conformal)
optimal = found.sphere
print(f"{found.ended} after {len(found.history) - 1} steps")

# %%
# Refinement alone, from any map without flips.

refined = omtwarp.refine_map(surface, optimal, weight="balanced").sphere

# %%
# Measurement alone, for maps from any source.

maps = {"conformal": conformal, "Moser": moser, "optimal": optimal, "refined, balanced": refined}
for name, sphere in maps.items():
    print(f"{name:18s} {omtwarp.distortion(surface, sphere)}")

checker = rasterize("checker", 1024)
sheet(
    [SurfaceView(surface.vertices, surface.faces, image=checker, sphere=sphere) for sphere in maps.values()],
    captions=list(maps),
    columns=2,
    size=(400, 380),
)
