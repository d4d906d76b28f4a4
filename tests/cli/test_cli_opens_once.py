"""Every command opens each of its inputs once."""

import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import omtwarp
from omtwarp.mesh.data import VertexData, write_data
from omtwarp.mesh.write import write_mesh

pytest.importorskip("nibabel")

# Runs the lines of a file, and prints how each ended and how often it opened what is in its folder.
DRIVER = """
import json, os, sys
from collections import Counter
from omtwarp.commands._cli import main
opened = Counter()

def hook(event, words):
    if event == "open" and not isinstance(words[0], int):
        folder, name = os.path.split(os.fsdecode(words[0]))
        if folder == sys.argv[2]:
            opened[name] += 1

sys.addaudithook(hook)
for line in json.load(open(sys.argv[1])):
    opened.clear()
    status = 0
    try:
        main(line.split())
    except SystemExit as end:
        status = end.code
    print(json.dumps([status, opened]), file=sys.__stderr__)
"""
QUICK = (
    "check {i}/ball.ply",
    "map {i}/lh.ball.surf.gii -o {o}/m.surf.gii --until conformal --device cpu",
    "map {i}/lh.white -o {o}/lh.sphere --until conformal --device cpu",
    "preview {i}/ball.npz -o {o}/p.png --size 16 --backend warp",
    "spharm {i}/ball.npz -o {o}/s.coef --degree 2",
    "texture {i}/named.obj --map {i}/ball.npz --uv own --image {i}/p.png -o {o}/t.glb --size 16 --device cpu",
    "texture --map {i}/ball.npz --bake {i}/z.shape.gii -o {o}/b.glb --size 16 --device cpu",
    "resample {i}/ball.npz --to ico1 --data {i}/z.shape.gii -o {o}/d.shape.gii",
    "resample {i}/lh.ball.surf.gii --surface {i}/ball.ply --to {i}/ball.npz --data {i}/lh.curv -o {o}/d.npy",
    "resample {i}/beside.ply --to ico1 -o {o}/w.ply",
    "align {i}/lh.ball.surf.gii --surface {i}/ball.ply --to {i}/ball.npz -o {o}/a.surf.gii",
    "align {i}/ball.npz --to {i}/lh.ball.surf.gii --feature {i}/lh.curv --to-feature {i}/z.shape.gii -o {o}/a.npz",
    "distance {i}/ball.npz {i}/other.npz --degree 2",
    "group {i}/blob.npz {i}/other.npz --grid ico1 --degree 2 -o {o}/group",
)
LONG = (
    "report {i}/ball.npz -o {o}/r.html --device cpu",
    "film {i}/ball.npz -o {o}/f.gif --size 16x16 --seconds 0.2 --fps 2 --pattern checker --backend warp",
    "register {i}/ball.npz --to {i}/other.npz -o {o}/g.npz --quiet --strain {o}/strain.npy",
)


@pytest.mark.parametrize("commands", [QUICK, pytest.param(LONG, marks=pytest.mark.slow)], ids=["quick", "long"])
def test_files_are_opened_once(tmp_path, commands):
    """Also those of which several parts of a command want something, and those that other packages read."""
    inputs, outputs = tmp_path / "in", tmp_path / "out"
    inputs.mkdir()
    outputs.mkdir()
    ball = omtwarp.shapes.icosphere(4)
    blob, values = omtwarp.shapes.blob(seed=3, sphere=320), ball.vertices[:, 2:]
    for name in ("ball.ply", "lh.ball.surf.gii", "lh.white"):
        write_mesh(inputs / name, ball.vertices, ball.faces)
    write_mesh(
        inputs / "beside.ply",
        ball.vertices,
        ball.faces,
        beside=dict(zip(("px", "py", "pz"), ball.vertices.T, strict=True)),
    )
    for name in ("z.shape.gii", "lh.curv"):
        write_data(inputs / name, VertexData(values, ("z",)))
    rows = [
        "mtllib none.mtl",
        *(f"v {x!r} {y!r} {z!r}" for x, y, z in ball.vertices.tolist()),
        "vt 0 0",
        "vt 1 0",
        "vt 0 1",
    ]
    rows += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in (ball.faces + 1).tolist()]
    (inputs / "named.obj").write_text("\n".join(rows))
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(inputs / "p.png")
    for name, surface in (("ball", ball), ("blob", blob), ("other", blob)):
        omtwarp.map_to_sphere(surface, until="conformal", device="cpu").save(inputs / f"{name}.npz")
    lines = [line.format(i=inputs, o=outputs) for line in commands]
    (tmp_path / "lines.json").write_text(json.dumps(lines))
    done = subprocess.run(
        [sys.executable, "-c", DRIVER, tmp_path / "lines.json", inputs],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
    )
    said = done.stderr
    counts = [json.loads(line) for line in said.splitlines() if line.startswith("[")]
    assert len(counts) == len(lines), said
    for line, (status, opened) in zip(commands, counts, strict=True):
        named = {word.rpartition("/")[2] for word in line.split() if word.startswith("{i}")}
        assert (status or 0, opened) == (0, dict.fromkeys(named, 1)), f"{line}\n{said}"
