"""Damaged files, and options out of range, made from a seed; each case is one command line.

``OMTWARP_HOSTILE_CASES`` says how many cases are made, and ``OMTWARP_HOSTILE_SEED`` where the seed starts.
"""

from __future__ import annotations

import gzip
import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from omtwarp.mapping.any_surface import map_surface
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

CASES = int(os.environ.get("OMTWARP_HOSTILE_CASES", "940"))
SEED = int(os.environ.get("OMTWARP_HOSTILE_SEED", "0"))

BALL = shapes.icosphere(2)


@dataclass(frozen=True)
class Case:
    """A case: its name, its command line, and the file that was made for it.

    Attributes:
        name: tells how the case was made, so that it can be made again.
        arguments: of the command; they name files in the folder that it runs in.
        file: name of the file to write before.
        content: of that file.
    """

    name: str
    arguments: tuple[str, ...]
    file: str = ""
    content: bytes = b""


def ascii_ply(vertices, faces) -> bytes:
    """A PLY file of text."""
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{x:.6g} {y:.6g} {z:.6g}\n" for x, y, z in vertices] + [f"3 {a} {b} {c}\n" for a, b, c in faces]
    return (head + "".join(rows)).encode()


def ascii_stl(vertices, faces) -> bytes:
    """An STL file of text."""
    corners = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.6g} {y:.6g} {z:.6g}\n" for x, y, z in vertices[face])
        + "endloop\nendfacet\n"
        for face in faces
    )
    return f"solid ball\n{corners}endsolid ball\n".encode()


def sound_files(folder: Path) -> dict[str, bytes]:
    """One small sound file of every format that is read, by name."""
    found: dict[str, bytes] = {}
    for suffix in ("ply", "obj", "off", "stl", "glb"):
        write_mesh(folder / f"ball.{suffix}", BALL.vertices, BALL.faces)
        found[f"ball.{suffix}"] = (folder / f"ball.{suffix}").read_bytes()
    found["text.ply"] = ascii_ply(BALL.vertices, BALL.faces)
    found["text.stl"] = ascii_stl(BALL.vertices, BALL.faces)
    result = MapResult(BALL.vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(len(BALL.vertices)))
    result.save(folder / "map.npz")
    found["map.npz"] = (folder / "map.npz").read_bytes()
    holed = map_surface((BALL.vertices, BALL.faces[1:]), domain="disk", device="cpu", until="moser")
    holed.save(folder / "disk-map.npz")
    found["disk-map.npz"] = (folder / "disk-map.npz").read_bytes()
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=12, minor_sections=6)
    map_surface(ring, domain="torus").save(folder / "torus-map.npz")
    found["torus-map.npz"] = (folder / "torus-map.npz").read_bytes()
    np.save(folder / "data.npy", BALL.vertices[:, 0])
    found["data.npy"] = (folder / "data.npy").read_bytes()
    stream = io.BytesIO()
    np.savez_compressed(stream, vertices=BALL.vertices, faces=BALL.faces)
    found["mesh.npz"] = stream.getvalue()
    for kind in ("png", "jpeg", "tiff"):
        stream = io.BytesIO()
        noise = np.random.default_rng(0).integers(0, 256, (16, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(stream, kind)
        found[f"picture.{kind}"] = stream.getvalue()
    try:
        import nibabel
    except ImportError:
        return found
    image = nibabel.gifti.GiftiImage()
    for intent, array in (("POINTSET", BALL.vertices.astype(np.float32)), ("TRIANGLE", BALL.faces.astype(np.int32))):
        code = f"NIFTI_INTENT_{intent}"
        image.add_gifti_data_array(nibabel.gifti.GiftiDataArray(array, intent=code, datatype=array.dtype.name))
    found["ball.gii"] = image.to_bytes()
    found["ball.gii.gz"] = gzip.compress(image.to_bytes())
    nibabel.freesurfer.write_geometry(folder / "lh.white", BALL.vertices, BALL.faces)
    found["lh.white"] = (folder / "lh.white").read_bytes()
    return found


def damaged(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Damage a file's content in one random way; return it and the name of the damage."""
    kind = str(rng.choice(["cut", "flipped", "zeroed", "noise", "twice", "hole", "number", "edge"]))
    data = bytearray(content)
    at = int(rng.integers(len(data)))
    if kind == "cut":
        return f"cut at {at}", bytes(data[:at])
    if kind == "edge":  # heads and tails, where the counts and the ends are
        at = int(rng.choice([1, 3, 8, 79, 80, 83, 84, 85, len(data) - 1, len(data) - 2, len(data) - 51]))
        return f"cut at {at}", bytes(data[: max(at, 0)])
    if kind == "flipped":
        places = rng.integers(len(data), size=int(rng.integers(1, 9)))
        for place in places:
            data[place] ^= 1 << int(rng.integers(8))
        return f"bits flipped at {places.tolist()}", bytes(data)
    if kind == "zeroed":
        length = int(rng.integers(1, 64))
        data[at : at + length] = bytes(len(data[at : at + length]))
        return f"zeros at {at}", bytes(data)
    if kind == "noise":
        data[at : at + 16] = rng.integers(0, 256, len(data[at : at + 16]), dtype=np.uint8).tobytes()
        return f"noise at {at}", bytes(data)
    if kind == "twice":
        return "twice", bytes(data + data)
    if kind == "hole":
        return f"hole at {at}", bytes(data[:at] + data[at + int(rng.integers(1, 64)) :])
    digits = [k for k, byte in enumerate(data) if 48 <= byte <= 57]  # a digit of a header, or of a number as text
    place = digits[int(rng.integers(len(digits)))] if digits else at
    inserted = bytes(rng.choice([b"9999999", b"-", b"e400", b".", b"nan", b"x", b" "]))
    return f"{inserted!r} at {place}", bytes(data[:place] + inserted + data[place:])


NUMBERS = ("0", "-1", "1", "2", "1e99", "1e-300", "nan", "inf", "-inf", "", " ", "²", "0x10", "1e400", "9" * 30, "1_0")
TEXTS = (*NUMBERS, "auto", "none", "é", "\x1b[31m", "a" * 300, "../..", "-", "--", "%s", "'", "\\", "0,0", "1,2,3", "y")
OPTIONS = {
    "check": (),
    "map": ("--method", "--until", "--cost", "--scheme", "--refine", "--device", "--report"),
    "texture": ("--image", "--pattern", "--projection", "--atlas", "--rotate", "--seam", "--size", "--device"),
    "preview": (
        "--size", "--view", "--zoom", "--field-of-view", "--projection", "--up", "--front", "--light", "--background",
        "--image", "--frames", "--fps", "--backend", "--device",
    ),
    "report": ("--image", "--pattern", "--title", "--up", "--device"),
    "align": ("--to", "--surface", "--to-surface", "--feature", "--to-feature", "--by", "--degree", "--radius"),
    "resample": ("--to", "--data", "--method", "--surface", "--sphere", "--matrix", "--device"),
    "spharm": ("--degree", "--fit", "--reconstruction", "--device"),
    "distance": ("--degree", "--device"),
    "group": ("--grid", "--components", "--degree", "--permutations", "--seed", "--device"),
    "demo": ("--faces", "--device"),
}  # fmt: skip
OUTPUTS = {
    "map": ("out.npz", "out.ply", "out.obj", "out.stl", "out.glb", "out.off"),
    "texture": ("out.glb", "out.obj", "out.ply"),
    "preview": ("out.png", "out.jpg", "out.webp"),
    "report": ("out.html",),
    "align": ("out.npz", "out.ply", "out.gii"),
    "resample": ("out.ply", "out.npy", "out.gii", "out.csv"),
    "spharm": ("out.coef", "out.csv", "out.npz"),
    "group": ("study",),
}
SUBJECTS = {
    "demo": [],
    "texture": ["--map", "map.npz"],
    "report": ["--map", "map.npz"],
    "preview": ["--map", "map.npz"],
    "align": ["map.npz"],
    "resample": ["map.npz", "--to", "ico1"],
    "spharm": ["--map", "map.npz", "--degree", "2"],
    "distance": ["map.npz", "map.npz", "--degree", "2"],
    "group": ["map.npz", "map.npz", "--grid", "ico1", "--degree", "2"],
}  # of the mesh ball.ply for all others
MAP_COMMANDS = (
    ("texture", "--map", "{}", "-o", "out.ply", "--size", "32"),
    ("report", "--map", "{}", "-o", "out.html"),
    ("preview", "{}", "-o", "out.png"),
    ("check", "{}"),
    ("unwrap", "{}", "-o", "out.glb"),
    ("film", "{}", "-o", "out.gif", "--size", "16x16", "--seconds", "0.2", "--fps", "2", "--backend", "warp"),
    ("align", "{}", "-o", "out.npz"),
    ("align", "map.npz", "--to", "{}", "-o", "out.ply"),
    ("resample", "{}", "--to", "ico1", "-o", "out.ply"),
    ("resample", "map.npz", "--to", "{}", "-o", "out.ply"),
    ("spharm", "--map", "{}", "-o", "out.csv", "--degree", "2"),
    ("distance", "{}", "map.npz", "--degree", "2"),
    ("group", "map.npz", "{}", "-o", "study", "--grid", "ico1", "--degree", "2"),
)
MESH_COMMANDS = (
    ("check", "{}"),
    ("check", "{}", "--repair"),
    ("check", "{}", "--repair", "-o", "out.obj"),
    ("map", "{}", "-o", "out.npz", "--until", "moser"),
    ("map", "{}", "-o", "out.npz", "--repair", "--until", "moser"),
    ("preview", "{}", "-o", "out.png"),
    ("align", "{}", "-o", "out.ply"),
    ("resample", "{}", "--to", "ico1", "-o", "out.ply"),
)
PICTURE_COMMANDS = (("texture", "--map", "map.npz", "-o", "out.glb", "--size", "32", "--image", "{}"),)
DATA_COMMANDS = (
    ("resample", "map.npz", "--to", "ico1", "--data", "{}", "-o", "out.npy"),
    ("align", "map.npz", "--to", "map.npz", "--feature", "{}", "--to-feature", "data.npy", "-o", "out.npz"),
)
BAD_OUTPUTS = ("", ".", "..", "none/out.npz", "out", "out.exe", "\x1b[31m.npz", "a" * 300 + ".npz", "-.npz", "folder")


def cases(folder: Path, count: int = CASES, seed: int = SEED) -> Iterator[Case]:
    """Make random cases, which are the same for the same seed.

    Args:
        folder: where the sound files are written, which some cases name.
        count: how many.
        seed: of the first.
    """
    sound = sound_files(folder)
    names = sorted(sound)
    for number in range(seed, seed + count):
        rng = np.random.default_rng(number)
        if rng.random() < 0.7:
            name = names[number % len(names)]
            how, content = damaged(sound[name], rng)
            if "picture" in name:
                kinds: tuple[tuple[str, ...], ...] = PICTURE_COMMANDS
            elif name.startswith("data"):
                kinds = DATA_COMMANDS
            else:
                kinds = MAP_COMMANDS if "map" in name else MESH_COMMANDS
            arguments = tuple(word.replace("{}", f"bad-{name}") for word in kinds[int(rng.integers(len(kinds)))])
            yield Case(f"{number}: {name} {how}", arguments, f"bad-{name}", content)
            continue
        command = str(rng.choice(list(OPTIONS)))
        words = [command, *SUBJECTS.get(command, ["ball.ply"])]
        if command in OUTPUTS:
            good = rng.random() < 0.8
            words += ["-o", str(rng.choice(OUTPUTS[command] if good else BAD_OUTPUTS))]
        for _ in range(int(rng.integers(1, 3))):
            if OPTIONS[command]:
                option = OPTIONS[command][int(rng.integers(len(OPTIONS[command])))]
                values = TEXTS if rng.random() < 0.5 else NUMBERS
                words += [option, values[int(rng.integers(len(values)))]]
        yield Case(f"{number}: {command} with options", tuple(words))
