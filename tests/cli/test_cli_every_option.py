"""Every value of every option of every command is used once, on small meshes; the list is that of the help itself."""

from __future__ import annotations

import json
import re
import shutil

import click
import numpy as np
import pytest
from PIL import Image

from omtwarp.commands import function_of
from omtwarp.commands._cli import SUMMARIES, main
from omtwarp.commands._command import as_command
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

# A command line of each command, to which options are added.
LINES = {
    "map": "map ball.ply -o map.npz --device cpu",
    "texture": "texture --map ball.npz -o texture.glb --size 64 --device cpu",
    "transfer": "transfer own.glb own.glb --map-from ball.npz --map-to ball.npz -o transfer.glb --size 32 --device cpu",
    "unwrap": "unwrap --map ball.npz -o unwrap.glb --device cpu",
    "preview": "preview ball.ply -o preview.png --size 24 --backend warp --device cpu",
    "film": "film --map ball.npz -o film.gif --size 16 --seconds 0.2 --fps 2 --backend warp --device cpu",
    "report": "report --map ball.npz -o report.html --device cpu",
    "align": "align ball.npz -o align.npz",
    "register": "register ball.npz --to other.npz -o register.npz",
    "resample": "resample ball.npz --to ico1 -o resample.ply --device cpu",
    "check": "check ball.ply",
    "cohort": "cohort table.csv -o cohort --workers 1 --device cpu",
    "spharm": "spharm --map ball.npz -o spharm.coef --degree 3 --device cpu",
    "distance": "distance ball.npz ball.npz --degree 3 --device cpu",
    "group": "group ball.npz other.npz -o group --grid ico1 --degree 3 --permutations 9 --device cpu",
    "demo": "demo -o demo --faces 2000 --device cpu --json --verbose --force",
}
# Another line, for options of which the one above makes no use.
FROM_A_MESH = {
    "texture": "texture ball.ply -o texture.glb --size 64 --device cpu",
    "film": "film ball.ply -o film.gif --size 16 --seconds 0.2 --fps 2 --backend warp --device cpu",
    "report": "report ball.ply -o report.html --device cpu",
    "unwrap": "unwrap ball.ply -o unwrap.glb --device cpu",
    "spharm": "spharm ball.ply -o spharm.coef --degree 3 --device cpu",
}
OF_A_MAP = {"--method", "--until", "--cost", "--scheme", "--refine", "--solver", "--repair", "--device"}
INSTEAD = {
    "map --beside": "map ball.ply -o map.ply --device cpu --until conformal",
    "map --weights-at": "map ball.ply -o map.npz --device cpu --weights numbers.npy",
    "map --weights-at triangles": "map ball.ply -o map.npz --device cpu --weights areas.npy",
    "map --target-floor": "map ball.ply -o map.npz --device cpu --target picture.png",
    "map --hemisphere": "map cup.ply -o map.npz --device cpu --until conformal",
    "map --disk": "map cup.ply -o map.npz --device cpu --until conformal",
    "map --cap": "map cup.ply -o map.npz --device cpu --until conformal",
    "map --fill-area": "map cup.ply -o map.npz --device cpu --until conformal",
    "map --components": "map two.ply -o map.npz --device cpu --until conformal",
    "map --together": "map two.ply -o map.npz --device cpu --until conformal",
    "map --cut": "map ring.ply -o map.npz --device cpu --until conformal",
    "map --cut-along": "map ring.ply -o map.npz --device cpu --until conformal",
    "map --radius": "map ball.ply -o map.ply --device cpu",
    "map --smoothing": "map labels.tif -o map.npz --device cpu --until conformal",
    "map --torus": "map ring.ply -o map.npz --device cpu",
    "texture --uv own": "texture own.glb --map ball.npz -o texture.glb --size 64 --device cpu",
    "texture --keep-materials": "texture own.glb --map ball.npz --uv own -o texture.glb --size 64 --device cpu",
    "texture --opacity":
        "texture own.glb --map ball.npz --uv own --keep-materials over -o texture.glb --size 64 --device cpu",
    "texture --bake normal": "texture --map ball.npz --detail ball.ply -o texture.glb --size 64 --device cpu",
    "texture --detail": "texture --map ball.npz --bake normal -o texture.glb --size 64 --device cpu",
    "texture --projection": "texture --map ball.npz --image picture.png -o texture.glb --size 64 --device cpu",
    "texture --seam": "texture --map ball.npz --atlas equirectangular -o texture.glb --size 64 --device cpu",
    "preview --map": "preview -o preview.png --size 24 --backend warp --device cpu",
    "preview --image": "preview ball.npz -o preview.png --size 24 --backend warp --device cpu",
    "preview --frames": "preview ball.ply -o preview.gif --size 24 --backend warp --device cpu",
    "preview --fps": "preview ball.ply -o preview.gif --frames 2 --size 24 --backend warp --device cpu",
    "align --surface": "align sphere.ply -o align.ply",
    "align --to-surface": "align ball.npz --to sphere.ply -o align.npz --degree 4",
    "align --to-feature": "align ball.npz --to other.npz --feature numbers.npy -o align.npz --degree 4",
    "align --feature": "align ball.npz --to other.npz --to-feature numbers.npy -o align.npz --degree 4",
    "align --by": "align ball.npz --to other.npz -o align.npz",
    "align --degree": "align ball.npz --to other.npz -o align.npz",
    "align --mirror": "align ball.npz --to other.npz -o align.npz --degree 4",
    "align --radius": "align ball.npz -o align.ply",
    "register --surface": "register sphere.ply --to other.npz -o register.ply",
    "register --to-surface": "register ball.npz --to sphere.ply -o register.npz",
    "register --to-feature": "register ball.npz --to other.npz --feature numbers.npy -o register.npz",
    "register --feature": "register ball.npz --to other.npz --to-feature numbers.npy -o register.npz",
    "register --feature-weight": (
        "register ball.npz --to other.npz --feature numbers.npy --to-feature numbers.npy -o register.npz"
    ),
    "register --radius": "register ball.npz --to other.npz -o register.ply",
    "register --hemisphere": "register ball.npz --to fsaverage5 -o register.npz",
    "register --group": "register ball.npz other.npz -o registered --rounds 1",
    "register --sequence": "register ball.npz other.npz -o registered",
    "register --rounds": "register ball.npz other.npz -o registered --group",
    "resample --to": "resample ball.npz --data numbers.npy -o resample.npy --device cpu",
    "resample --data": "resample ball.npz --to ico1 -o resample.npy --device cpu",
    "resample --labels": "resample ball.npz --to ico1 --data labels.npy -o resample.npy --device cpu",
    "resample --surface": "resample sphere.ply --to ico1 -o resample.ply --device cpu",
    "group --covariate":
        "group members.csv -o group --grid ico1 --degree 3 --permutations 9 --device cpu --components 1",
    # By words in another order these are used apart: with them other options have less to do.
    "cohort --collect": "cohort table.csv --workers 1 -o cohort --device cpu",
    "cohort --register": "cohort table.csv --workers 1 --device cpu -o cohort",
    "cohort --until": "cohort table.csv --device cpu --workers 1 -o cohort",
    "cohort --method": "cohort table.csv --device cpu -o cohort --workers 1",
    "film --method": "film ball.ply -o film.gif --size 16 --seconds 0.2 --fps 2 --device cpu --backend warp",
    "report --method": "report ball.ply --device cpu -o report.html",
    "report --until": "report -o report.html ball.ply --device cpu",
    "check --output": "check ball.ply --repair",
}  # fmt: skip
# Values of options whose help names a kind of value in place of one.
VALUES = {
    "--output": [], "--map": ["ball.npz"], "--map-from": ["ball.npz"], "--map-to": ["ball.npz"],
    "--image": ["picture.png"], "--target": ["picture.png"], "--target-floor": ["0.2"], "--weights": ["numbers.npy"],
    "--report": ["facts.json"], "--radius": ["100"], "--smoothing": ["5"], "--device": [],
    "--refine": ["0.5", "match:2.5"],
    "--opacity": ["0", "1"], "--detail": ["ball.ply"], "--bake": ["numbers.npy"], "--rotate": ["10", "10,20,30"],
    "--seam": ["90"], "--size": ["32"], "--title": ["A ball"], "--up": ["y", "-x"], "--front": ["x"],
    "--zoom": ["1.5"], "--field-of-view": ["40"], "--background": ["black"], "--frames": ["2"], "--fps": ["2"],
    "--seconds": ["0.3"], "--surface": ["ball.ply"], "--to-surface": ["ball.ply"], "--feature": ["numbers.npy"],
    "--to-feature": ["numbers.npy"], "--degree": ["2"], "--data": ["numbers.npy"], "--sphere": ["grid.ply"],
    "--matrix": ["matrix.npz"], "--reconstruction": ["smooth.ply"], "--grid": ["ico0"],
    "--components": ["1"], "--permutations": ["3"], "--seed": ["7"], "--covariate": ["age"],
    "--workers": ["2"], "--shard": ["1/2"],
    "--time-limit": ["100"], "--memory-limit": ["2"], "--aspect": ["2"], "--margin": ["0.01"], "--subdivide": ["1"],
    "--feature-weight": ["2"], "--landmarks": ["places.csv"], "--keep-areas": ["3", "exact"],
    "--strain": ["strain.npy"],
    "--before": ["before.ply"], "register --report": ["page.html"], "--film": ["warp.gif"], "--rounds": ["1"],
    "--stiffness": ["2"], "--max-strain": ["1.5"], "--sizes": [], "--shape": [],
    "--repeats": ["1"], "--faces": [],
    "map --output": ["o.ply", "o.obj", "o.off", "o.stl", "o.glb", "o.vtk"],
    "texture --output": ["o.obj", "o.ply"],
    "texture --size": ["64x64"],
    "preview --view": ["front", "back", "left", "right", "top", "bottom", "three-quarter", "six", "30,20"],
    "preview --output": ["o.jpg", "o.webp", "o.tif", "o.gif"],
    "film --size": ["24x16"],
    "film --view": ["left", "30,20"],
    "align --to": ["other.npz"],
    "align --output": ["o.ply"],
    "register --to": ["other.npz"],
    "register --output": ["o.ply"],
    "resample --to": [
        "other.npz", "sphere.ply", "ico0", "fsaverage3", "healpix:2", "equiangular:4x8", "octahedral:4",
    ],
    "check --output": ["o.ply"],
    "cohort --register": ["other.npz"],
    "cohort --executor": ["local"],  # clusters have tests of their own
    "spharm --output": ["o.csv", "o.npz"],
}  # fmt: skip
TYPES = ("float", "integer", "text", "path")  # names of kinds of values in a record of help
# Commands that take seconds: their lines have several options each, but for those that exclude each other.
PICTURES = ("film", "report")  # from a mesh
JOINED = (*PICTURES, "register", "distance", "group", "cohort")
NOT_WITH = {"--pattern": ("--image",), "--image": ("--pattern",), "--front": ("--up",), "--up": ("--front",)}
NOT_WITH |= {"--quiet": ("--json",), "--json": ("--quiet",)}
# Values that ask for minutes or for a machine that may not be there, and have tests of their own.
ELSEWHERE = {
    "preview --backend auto", "preview --backend pyrender", "film --backend auto", "film --backend pyrender",
    "cohort --executor dask", "cohort --executor slurm", "cohort --executor submitit-local", "texture --size auto",
    "demo --json", "demo --verbose", "demo --quiet", "demo --force", "demo --device cpu",
    *(f"{command} --solver cudss" for command in LINES),
}  # fmt: skip


def values_of(command: str, option: str, shown: str) -> list[str | None]:
    """Return the values of an option: None for a flag, words of its help as they are, and examples of its kinds."""
    words = shown.strip("<>").split("|") if shown else []
    if not words:
        return [None]
    plain = [word for word in words if re.fullmatch(r"[a-z][a-z0-9-]*", word) and word not in TYPES]
    if len(plain) == len(words):
        return list(plain)
    examples = VALUES.get(f"{command} {option}", VALUES.get(option))
    assert examples is not None, f"no example of a value for '{command} {option} {shown}'"
    return [*plain, *examples]


def options_of(command: str) -> list[tuple[str, str]]:
    """Return the names of a command's options, and what its help shows for their values."""
    described = as_command(function_of(command))
    context = click.Context(described)
    options = []
    for parameter in described.get_params(context):
        if parameter.param_type_name == "argument" or parameter.name == "help":
            continue
        shown = parameter.get_help_record(context)[0]
        # The record is as "--name, -n VALUES" or "--yes / --no".
        names, values = re.fullmatch(r"((?:-[\w-]+(?:, | / |))+)(?: (.*))?", shown).groups()
        options += [(name, values or "") for name in re.split(r", | / ", names) if name.startswith("--")]
    return options


def every_line(command: str) -> list[list[str]]:
    """Return a command line for every value of every option of a command; some lines have several options."""
    found = [LINES[command].split()]
    joined: list[tuple[list[str], list[str]]] = []  # what lines begin with, and the options that they have after it
    for option, shown in options_of(command):
        for value in values_of(command, option, shown):
            words = [option] if value is None else [option, value]
            if f"{command} {' '.join(words)}" in ELSEWHERE or (option == "--device" and value == "auto"):
                continue
            from_a_mesh = option in OF_A_MAP or (command in PICTURES and option != "--map")
            usual = FROM_A_MESH.get(command, LINES[command]) if from_a_mesh else LINES[command]
            line = INSTEAD.get(f"{command} {' '.join(words)}", INSTEAD.get(f"{command} {option}", usual)).split()
            if option in ("--map", "--output"):
                at = line.index("-o") if option == "--output" and "-o" in line else None
                at = line.index("--map") if option == "--map" and "--map" in line else at
                if at is not None:
                    del line[at : at + 2]
            apart = {option, *NOT_WITH.get(option, ())}
            if command in JOINED:
                options = next((more for begun, more in joined if begun == line and not apart & set(more)), None)
                if options is not None:
                    options += words
                    continue
            if sorted(line + words) not in map(sorted, [*found, *(begun + options for begun, options in joined)]):
                joined.append((line, words))
    return found + [begun + options for begun, options in joined]


def ring_of(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a torus of so many rows and columns."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    around, across = 2 * np.pi * row / rows, 2 * np.pi * column / columns
    width = 3.0 + np.cos(across)
    vertices = np.stack([width * np.cos(around), width * np.sin(around), np.sin(across)], axis=1)
    ahead, beside = (row + 1) % rows * columns, (column + 1) % columns
    corners = [row * columns + column, ahead + column, ahead + beside, row * columns + beside]
    return vertices, np.concatenate([np.stack([corners[k] for k in face], 1) for face in ((0, 1, 2), (0, 2, 3))])


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with everything that the command lines name."""
    folder = tmp_path_factory.mktemp("inputs")
    ball = shapes.blob(seed=2, amplitude=0.2, sphere=shapes.icosphere(3))
    write_mesh(folder / "ball.ply", ball.vertices, ball.faces)
    again = ball.vertices + 3.0
    write_mesh(
        folder / "two.ply",
        np.concatenate([ball.vertices, again]),
        np.concatenate([ball.faces, ball.faces + len(again)]),
    )
    used, lower = np.unique(ball.faces[ball.vertices[ball.faces].mean(axis=1)[:, 2] < 0.3], return_inverse=True)
    write_mesh(folder / "cup.ply", ball.vertices[used], lower.reshape(-1, 3))
    ring = ring_of(16, 8)
    write_mesh(folder / "ring.ply", *ring)
    write_mesh(folder / "sphere.ply", shapes.icosphere(3).vertices, ball.faces)
    (folder / "places.csv").write_text("label,side,vertex\na,moving,1\na,target,1\n")
    np.save(folder / "numbers.npy", ball.vertices[:, 0] - ball.vertices[:, 0].min() + 1.0)
    np.save(folder / "areas.npy", np.ones(len(ball.faces)))
    np.save(folder / "labels.npy", (ball.vertices[:, 0] > 0).astype(np.int64))
    Image.fromarray(np.tile(np.arange(64, dtype=np.uint8)[:, None, None] + 60, (1, 128, 3))).save(
        folder / "picture.png"
    )
    box = np.zeros((8, 8, 8), np.uint8)
    box[2:6, 2:6, 2:6] = 1
    first, *rest = (Image.fromarray(page) for page in box)
    first.save(folder / "labels.tif", save_all=True, append_images=rest)
    (folder / "table.csv").write_text("path\nball.ply\n", "utf-8")
    members = [f"m{k},{'other' if k % 2 else 'ball'}.npz,{50 + k}\n" for k in range(6)]
    (folder / "members.csv").write_text("id,path,age\n" + "".join(members), "utf-8")
    return folder


def ended(capsys, words: list[str]) -> tuple[int, str]:
    """Run a command; return its exit status and what it says on standard error."""
    with pytest.raises(SystemExit) as end:
        main(words)
    return int(end.value.code or 0), capsys.readouterr().err


@pytest.fixture(scope="module")
def place(inputs):
    """The folder, with maps and a textured mesh made in it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(inputs)
        for line in (
            "map ball.ply -o ball.npz --device cpu",
            "map ball.ply -o other.npz --device cpu --until conformal",
            "unwrap --map ball.npz -o plain.glb --device cpu",
            "texture plain.glb --map ball.npz --uv own -o own.glb --size 32 --device cpu",
        ):
            with pytest.raises(SystemExit) as end:
                main([*line.split(), "-q"])
            assert not end.value.code, line
        yield inputs


def test_every_command_has_a_line():
    assert set(LINES) == set(SUMMARIES)


@pytest.mark.parametrize("command", LINES)
def test_every_value_of_every_option_works(place, capsys, small_pictures, short_warps, items_here, command):
    """No line of any value ends in an error.

    Warps take few steps on a coarse grid: how well they do is tested elsewhere.
    """
    failed = {}
    for words in every_line(command):
        shutil.rmtree("cohort", ignore_errors=True)
        status, said = ended(capsys, words)
        if status or "Traceback" in said:
            failed[" ".join(words)] = said.strip().splitlines()[-1:]
    assert not failed, json.dumps(failed, indent=1)
