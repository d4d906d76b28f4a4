"""
Many surfaces, one of them bad
==============================

A cohort is mapped by separate processes, and the results are collected in one table. A surface that cannot be mapped is
a row of it, and a second run finds nothing to do.
"""

import tempfile
from pathlib import Path

import omtwarp
from omtwarp.cohort import read_manifest, run_cohort
from omtwarp.cohort.tables import read_table
from omtwarp.mesh.write import write_mesh
from omtwarp.render import SurfaceView, sheet

folder = Path(tempfile.mkdtemp())
(folder / "in").mkdir()
for seed in range(4):
    shape = omtwarp.shapes.blob(seed, amplitude=0.2, degree=4, sphere=500)
    faces = shape.faces[1:] if seed == 3 else shape.faces  # the last has a hole
    write_mesh(folder / "in" / f"sub-{seed + 1:02}.ply", shape.vertices, faces)

items = read_manifest(folder / "in")
first = run_cohort(items, folder / "out", workers=1, until="moser")
again = run_cohort(items, folder / "out", workers=1, until="moser")
print(first.counts, "computed:", first.computed, "and then", again.computed)

# %%
# The table has a row for every surface.

rows = read_table(first.table)
for row in rows:
    print(row["id"], row["status"], row["flips"], row["area"] or row["message"])

# %%
# The maps are files as ``omtwarp map`` writes them.

done = [omtwarp.MapResult.load(folder / "out" / "maps" / f"{row['id']}.npz") for row in rows if row["status"] == "ok"]
views = [SurfaceView(one.vertices, one.faces, color="#c9b79c") for one in done]
sheet(views, captions=[row["id"] for row in rows if row["status"] == "ok"], columns=3, size=(360, 320))
