"""Files of every format that announce more than they hold: one line each, before any memory is taken for it."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
import struct
import sys
import threading
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.files.limits import ROOM, TIMES, memory_for_file
from omtwarp.mesh.data import read_data
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing import read_painted_mesh

MANY = 10**12
PATIENCE = 5.0  # seconds for a file of a few hundred bytes, most of it for loading the reader


def ply(form: str, vertices: int, element: str, kind: str, first: int) -> bytes:
    """A PLY of one polygon or strip whose number of corners is ``first``."""
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element {element}\nproperty list {kind} int vertex_indices\nend_header\n"
    if form == "ascii":
        return f"{head}0 0 0\n1 0 0\n0 1 0\n{first} 0 1 2\n".encode()
    order = "<" if "little" in form else ">"
    count = struct.pack(order + {"uchar": "B", "uint": "I"}[kind], first)
    return head.encode() + bytes(36) + count + bytes(12)


def vtk(binary: bool, dataset: str, points: int, cells: str = "", first: int = 3) -> bytes:
    head = (
        f"# vtk DataFile Version 3.0\na\n{'BINARY' if binary else 'ASCII'}\nDATASET {dataset}\nPOINTS {points} float\n"
    )
    numbers = bytes(36) if binary else b"0 0 0 1 0 0 0 1 0"
    corners = struct.pack(">4i", first % 2**31, 0, 1, 2) if binary else f"{first} 0 1 2".encode()
    return head.encode() + numbers + f"\n{cells}\n".encode() + corners + b"\n"


def vtp(text: str, form: str, attributes: str = "", polygons: str = "3") -> bytes:
    points = f'<DataArray type="Float32" NumberOfComponents="3" format="{form}">{text}</DataArray>'
    corners = '<DataArray type="Int64" Name="connectivity" format="ascii">0 1 2</DataArray>'
    ends = f'<DataArray type="Int64" Name="offsets" format="ascii">{polygons}</DataArray>'
    piece = f'<Piece NumberOfPoints="{MANY}" NumberOfPolys="{MANY}"><Points>{points}</Points>'
    piece += f"<Polys>{corners}{ends}</Polys></Piece>"
    return f'<VTKFile type="PolyData" version="1.0" {attributes}><PolyData>{piece}</PolyData></VTKFile>'.encode()


def gifti(rows: int, data: str = "AAAA") -> bytes:
    array = '<DataArray Intent="{}" DataType="{}" ArrayIndexingOrder="RowMajorOrder" Dimensionality="2" Dim0="{}" '
    array += 'Dim1="3" Encoding="Base64Binary" Endian="LittleEndian" ExternalFileName="" ExternalFileOffset="">'
    array += "<Data>{}</Data></DataArray>"
    arrays = array.format("NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32", rows, data)
    arrays += array.format("NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_INT32", rows, data)
    return f'<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="2">{arrays}</GIFTI>'.encode()


def glb(**points) -> bytes:
    """A GLB whose accessor of points is the one given."""
    whole = {"bufferView": 0, "componentType": 5125, "count": 3, "type": "SCALAR"}
    accessors = [{"componentType": 5126, "type": "VEC3", **points}, whole]
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    document |= {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "buffers": [{"byteLength": 64}]}
    document |= {"bufferViews": [{"buffer": 0, "byteLength": 64}]}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", 64, 0x004E4942) + bytes(64)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def npy(*shape: int) -> bytes:
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + bytes(24)


def npz(**arrays: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data)
    return stream.getvalue()


def xml_bomb(root: bytes) -> bytes:
    """A markup whose entities stand for 20 of one another, nine deep."""
    entities = b'<!ENTITY a "aaaaaaaaaaaaaaaaaaaa">'
    entities += b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 20) for k in range(9))
    return b'<?xml version="1.0"?><!DOCTYPE l [' + entities + b"]>" + root


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
GMSH = b"$MeshFormat\n%s 8\n%s$EndMeshFormat\n$Nodes\n%s\n$EndNodes\n"
ONE = struct.pack("<i", 1) + b"\n"
LONG = 2**31 - 1
MESHES = {
    **{f"points {form}.ply": ply(form, MANY, "face 1", "uchar", 3) for form in FORMS},
    **{f"faces {form}.ply": ply(form, 3, f"face {MANY}", "uchar", 3) for form in FORMS},
    **{f"polygon {form}.ply": ply(form, 3, "face 1", "uint", 4_000_000_000) for form in FORMS},
    **{f"strip {form}.ply": ply(form, 3, "tristrips 1", "uint", 4_000_000_000) for form in FORMS},
    "points.off": b"OFF\n%d 1 0\n0 0 0\n" % MANY,
    "faces.off": b"OFF\n3 %d 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n" % MANY,
    "polygon.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n%d 0 1 2\n" % MANY,
    "digits.off": b"OFF\n" + b"9" * 5000 + b" 1 0\n",
    "digits.obj": b"v 0 0 0\nf 1 2 " + b"9" * 5000 + b"\n",
    "a.stl": bytes(80) + b"\xff" * 4 + bytes(50),
    "mni.obj": b"P 0.3 0.3 0.4 10 1 %d\n0 0 0\n" % MANY,
    "faces.mz3": struct.pack("<HHIII", 23117, 3, 2**32 - 1, 2**32 - 1, 0),
    "skip.mz3": struct.pack("<HHIII", 23117, 3, 1, 3, 2**32 - 1),
    "lh.asc": b"#!ascii\n%d 1\n0 0 0 0\n" % MANY,
    "plates.tab": b"%d 1\n1 0 0 0\n" % MANY,
    "lh.white": b"\xff\xff\xfecreated\n\n" + struct.pack(">ii", LONG, LONG) + bytes(40),
    "lh.pial": b"\xff\xff\xff" + b"\xff" * 6 + bytes(40),
    "rh.pial": b"\xff\xff\xfd" + b"\xff" * 6 + bytes(40),
    **{f"points {binary}.vtk": vtk(binary, "POLYDATA", MANY) for binary in (0, 1)},
    **{f"polygons {binary}.vtk": vtk(binary, "POLYDATA", 3, f"POLYGONS {MANY} {4 * MANY}") for binary in (0, 1)},
    **{f"cells {binary}.vtk": vtk(binary, "UNSTRUCTURED_GRID", 3, f"CELLS {MANY} {4 * MANY}") for binary in (0, 1)},
    **{f"strip {binary}.vtk": vtk(binary, "POLYDATA", 3, f"TRIANGLE_STRIPS 1 {MANY}", MANY) for binary in (0, 1)},
    "offsets.vtp": vtp("0 0 0", "ascii", polygons=str(MANY)),
    "head.vtp": vtp(base64.b64encode(struct.pack("<Q", 2**60)).decode(), "binary", 'header_type="UInt64"'),
    "blocks.vtp": vtp(
        base64.b64encode(struct.pack("<4Q", 2**40, 2**40, 2**40, 8)).decode(),
        "binary",
        'header_type="UInt64" compressor="vtkZLibDataCompressor"',
    ),
    "bomb.vtp": xml_bomb(b'<VTKFile type="PolyData"><x>&j;</x></VTKFile>'),
    "rows.gii": gifti(MANY),
    "bomb.gii": xml_bomb(b'<GIFTI Version="1.0" NumberOfDataArrays="1"><MetaData>&j;</MetaData></GIFTI>'),
    "text2.msh": GMSH % (b"2.2 0", b"", b"%d\n1 0 0 0" % MANY),
    "binary2.msh": GMSH % (b"2.2 1", ONE, b"%d\n" % MANY + bytes(40)),
    "text4.msh": GMSH % (b"4.1 0", b"", b"1 %d 1 %d\n2 1 0 %d\n1\n0 0 0" % (MANY, MANY, MANY)),
    "binary4.msh": GMSH % (b"4.1 1", ONE, struct.pack("<4Q3iQ", 1, MANY, 1, MANY, 2, 1, 0, MANY) + bytes(40)),
    "points.mesh": b"MeshVersionFormatted 2\nDimension 3\nVertices\n%d\n0 0 0 0\nEnd\n" % MANY,
    "faces.mesh": b"MeshVersionFormatted 2\nDimension 3\nVertices\n1\n0 0 0 0\nTriangles\n%d\n1 1 1 0\nEnd\n" % MANY,
    "element.inp": b"*NODE\n1,0,0,0\n*ELEMENT, TYPE=S3\n1,1,1,%d\n" % MANY,
    "range.inp": b"*NODE\n1,0,0,0\n*NSET, NSET=a, GENERATE\n1,%d,1\n" % MANY,
    "device.inp": b"*Include, INPUT=/dev/zero\n*NODE\n1,0,0,0\n",
    "a.npz": npz(vertices=npy(MANY, 3), faces=npy(1, 3)),
    "view.glb": glb(bufferView=0, count=MANY),
    "zeros.glb": glb(count=10**10),
    "sparse.glb": glb(count=10**10, sparse={"count": 1, "indices": {"bufferView": 0}, "values": {"bufferView": 0}}),
}
_COLORS = struct.pack(">iiiii", 1, 0, 0, 1, LONG) + struct.pack(">i", LONG) + bytes(30)
DATA = {
    "a.npy": npy(MANY),
    "b.npy": npy(2**62, 2),
    "labels.annot": struct.pack(">i", LONG) + bytes(40),
    "colors.annot": _COLORS,
    "rows.shape.gii": gifti(MANY),
    **{f"points {form}.ply": MESHES[f"points {form}.ply"] for form in FORMS},
    **{f"polygon {form}.ply": MESHES[f"polygon {form}.ply"] for form in FORMS},
}


@pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded on Linux alone")
@pytest.mark.parametrize(("name", "read"), [*((n, read_mesh) for n in MESHES), *((n, read_data) for n in DATA)])
def test_what_is_announced_and_not_there_is_one_line(tmp_path, name, read):
    path = Path(tmp_path / name)
    path.write_bytes((MESHES if read is read_mesh else DATA)[name])
    begun = time.process_time()
    with pytest.raises(OmtwarpError, match=f"^{re.escape(str(path))}: ") as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert time.process_time() - begun < PATIENCE


@pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded on Linux alone")
@pytest.mark.parametrize("name", ["ball.obj", "ball.obj.gz", "ball.gii", "ball.glb"])
def test_a_small_file_takes_little_room(tmp_path, name):
    """Of the address space too, which a limit on memory counts."""
    ball = icosphere(2)
    write_mesh(tmp_path / name.removesuffix(".gz"), ball.vertices, ball.faces)
    if name.endswith(".gz"):
        (tmp_path / name).write_bytes(gzip.compress((tmp_path / name.removesuffix(".gz")).read_bytes()))
    read_mesh(tmp_path / name)  # which loads the reader
    with memory_for_file(-(ROOM - 2**28) // TIMES):
        assert len(read_mesh(tmp_path / name).faces) == len(ball.faces)
    with pytest.raises(OmtwarpError, match=r"damaged: asks for more than"), memory_for_file(100):
        np.ones(ROOM)


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is Linux's")
def test_threads_that_parse_at_once_leave_the_process_its_memory():
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    begun, over = threading.Event(), threading.Event()

    def parse_first():
        with memory_for_file(100):
            begun.set()
            over.wait(0.2)

    def parse_second():
        begun.wait()
        with memory_for_file(100):
            over.set()
            first.join()  # ends while this one parses, if it may

    first, second = threading.Thread(target=parse_first), threading.Thread(target=parse_second)
    first.start()
    second.start()
    second.join()
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_pictures_beside_a_mesh_are_no_part_of_its_bound(tmp_path, monkeypatch):
    """A small mesh may have large pictures: only its parser is bounded by its size."""
    monkeypatch.setattr("omtwarp.files.limits.ROOM", 0)
    monkeypatch.setattr("omtwarp.files.limits.TIMES", 1000)
    rows = ["mtllib a.mtl", "v 0 0 0", "v 1 0 0", "v 0 1 0", "vt 0 0", "usemtl a", "f 1/1 2/1 3/1"]
    (tmp_path / "a.obj").write_text("\n".join(rows), "ascii")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd a.png\n", "ascii")
    Image.new("RGB", (4000, 3000), (200, 30, 30)).save(tmp_path / "a.png")
    assert read_painted_mesh(tmp_path / "a.obj").materials[0].picture.shape == (3000, 4000, 3)


def test_readers_of_simulations_open_no_other_file(tmp_path):
    """Formats that are read by meshio through trimesh may name any file, so none of them is offered."""
    text = b'<Xdmf><Domain><Grid><DataItem Format="Binary">/dev/zero</DataItem></Grid></Domain></Xdmf>'
    for name in ("a.xdmf", "a.xmf", "a.e", "a.h5m", "a.node", "a.cgns"):
        (tmp_path / name).write_bytes(text)
        with pytest.raises(OmtwarpError, match="unknown format"):
            read_mesh(tmp_path / name)
