"""``omtwarp map`` and ``demo``: a mesh in, its map to the sphere out; and every step, on a generated shape."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import omtwarp
from omtwarp.commands import _work
from omtwarp.commands._options import ROUTE, Argument, Only, Printing, Typed, output_option
from omtwarp.commands._streams import input_file, say
from omtwarp.commands._work import make_map, require_bijective
from omtwarp.commands.texture import standing
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_output, check_outputs, folder_of_results, make_folder, staged, write_text
from omtwarp.options import CutAlong, Device, Domain, FillArea, MapOptions, WeightsAt

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from omtwarp.commands._work import Input
    from omtwarp.maps.result import MapResult
    from omtwarp.mesh.read import JoinedMesh


@dataclass(frozen=True)
class Topology:
    """What is done with holes, handles and several parts.

    Options:
        hemisphere: Map a surface with a hole to the hemisphere, the boundary on the equator.
        disk: Map a surface with a hole to the unit disk, by Lambert's equal-area projection.
        cap: Map a surface with a hole to a spherical cap of the area that the filled hole leaves.
        fill_area: Fill holes, on the sphere as large as they are or small; the filling is in the .npz only.
        components: Map every part of the surface by itself, each to a sphere of its own.
        together: Map all parts to disjoint caps of one sphere, in proportion to their areas.
        cut: Cut handles open along short loops and map to the sphere; textures have seams there.
        cut_along: Cut along the shortest loops, around handles, or through the holes that these make, which leaves
            fewer limbs.
        torus: Map a closed surface of genus 1 to a flat torus.
    """

    hemisphere: bool = False
    disk: bool = False
    cap: bool = False
    fill_area: FillArea | None = None
    components: bool = False
    together: bool = False
    cut: bool = False
    cut_along: CutAlong | None = None
    torus: bool = False

    def keywords(self) -> dict[str, object] | None:
        """Return the options of :func:`omtwarp.map_surface`; None where the surface has to be a sphere.

        Raises:
            OmtwarpError: options of more than one domain are given, or some that its surfaces have no use for.
        """
        rims = [domain for domain in (Domain.HEMISPHERE, Domain.DISK, Domain.CAP, Domain.TORUS) if vars(self)[domain]]
        if len(rims) > 1:
            raise OmtwarpError(f"both --{rims[0]} and --{rims[1]}: give one")
        if self.together and rims:
            raise OmtwarpError(f"both --together and --{rims[0]}: parts side by side lie on caps")
        if self.torus and (self.cut or self.cut_along or self.fill_area):
            raise OmtwarpError("--torus is for whole surfaces: leave --cut, --cut-along and --fill-area out")
        if self == Topology():
            return None
        return {
            "domain": Domain.AUTO if self.together else rims[0] if rims else Domain.SPHERE,
            "fill_area": self.fill_area or FillArea.NATURAL,
            "components": self.components or self.together,
            "together": self.together,
            "cut": self.cut or self.cut_along is not None,
            "cut_along": self.cut_along or CutAlong.AUTO,
        }

    def idle(self, result: MapResult) -> bool:
        """Return whether options were given for what the surface of a map does not have."""
        whole = self != Topology() and result.domain == Domain.SPHERE and result.part is None
        return whole and result.filled_faces is None


@dataclass(frozen=True)
class Mass:
    """How much of the sphere the parts of the surface are to cover.

    Raises:
        OmtwarpError: an option is given without the one that it belongs to.

    Options:
        weights (FILE): Numbers per vertex or triangle (.npy, .csv, .gii, ...): twice the weight, twice the area.
        weights_at: What the weights belong to; auto goes by their number.
        target_picture (IMAGE): An equirectangular picture as the density to reach: bright regions get more mass.
        target_floor (SHARE): Raise the target's dark parts to this share of its mean.
    """

    weights: Path | None = None
    weights_at: WeightsAt = WeightsAt.AUTO
    target_picture: Annotated[Path | None, Typed("--target")] = None
    target_floor: float = 0.0

    def __post_init__(self) -> None:
        _work.refuse({"--weights-at is of --weights": self.weights is None and self.weights_at is not WeightsAt.AUTO})
        _work.refuse({"--target-floor is of --target": self.target_picture is None and self.target_floor})

    def target(self) -> omtwarp.TargetDensity | None:
        """Return the density that is to be reached, None for the uniform one.

        Raises:
            OmtwarpError: the picture cannot be read, or is no density.
        """
        if self.target_picture is None:
            return None
        from omtwarp.texturing.density import as_target

        return as_target(self.target_picture, self.target_floor)


def run_map(
    *,
    meshes: Annotated[list[Path], Argument(file=input_file)],
    output: Annotated[Path, output_option(".npz")],
    mapping: Annotated[MapOptions, Only((*ROUTE, "exact", "strict"))],
    topology: Topology,
    mass: Mass,
    report: Path | None = None,
    repair: bool = False,
    smoothing: Annotated[int | None, Typed(bounds=(0, 1000))] = None,
    beside: bool = False,
    radius: Annotated[float, Typed(bounds=(1e-06, 1000000000.0))] = 1.0,
    up: str | None = None,
    front: str | None = None,
    printing: Printing,
) -> None:
    """Map a surface to the unit sphere, with its area preserved.

    OUTPUT.npz holds vertices, faces, sphere, conformal and density (float64, in the input's order). A mesh suffix
    (.ply, .obj, .off, .stl, .glb, .vtk, GIFTI's .surf.gii, FreeSurfer's lh.sphere) holds the sphere with the input's
    faces. Copies of vertices along seams of a texture are joined: the .npz holds each once, and says in vertex_of_file
    which one each of the file's is; a mesh has all of them.

    With --exact the map is that of the mesh with its triangles cut into four, and OUTPUT.npz says which triangle every
    part comes from (face_origin) and which vertices are new (vertex_origin is -1).

    With --weights parts of the surface cover more of the sphere than their area; with --target the sphere is not filled
    evenly but as a picture says.

    A surface with holes, handles or several parts is mapped with --hemisphere, --disk, --cap, --fill-area, --cut and
    --components; "omtwarp check" says what each would do with it. As a mesh a disk is flat, parts have spheres about
    one centre, and a torus is a ring torus, or in a .glb the surface with a texture.

    Examples:
        omtwarp map bunny.ply -o bunny.npz
        omtwarp map left.ply right.ply -o maps --json
        omtwarp map head.ply -o head.npz --weights face.npy --target importance.png
        cat bunny.ply | omtwarp map - -o - | omtwarp texture --map - -o bunny.glb

    Options:
        output: .npz for the whole map, or a mesh suffix for the sphere; - for .npz; a directory for several.
        report (JSON): Write the report: what was done, and the map's quality; a directory for several.
        smoothing: Rounds of smoothing of the surfaces of a volume's labels; 20 by default.
        beside: For .ply: the surface, with its sphere as px, py, pz at the vertices.
        meshes (MESH): Closed triangle meshes of any format; - is standard input.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
        radius: Radius of a sphere that is written as a mesh; FreeSurfer's is 100.
        up (AXIS): The axis of the mesh towards the north pole; its shortest by default.
        front (AXIS): The axis towards longitude 0; guessed where --up is given.
    """

    from omtwarp.mesh.neuro import structure_of, volume_geometry_of
    from omtwarp.mesh.write import SUFFIXES

    if topology.torus and beside:
        raise OmtwarpError("--beside is for maps to the sphere: a ring torus is written by itself")
    targets = _work.outputs_of(meshes, output, ".ply" if beside else ".npz")
    reports = _work.outputs_of(meshes, report, ".json")
    suffixes = (".ply",) if beside else (".npz", *SUFFIXES)
    check_outputs([*((target, suffixes) for target in targets), *((one, (".json",)) for one in reports)], *meshes)
    whole = targets[0].suffix.lower() in ((".npz", ".glb") if topology.torus else (".npz",))  # a textured torus
    _work.refuse({f"--radius is for spheres as meshes, not for {targets[0].suffix}": whole and radius != 1.0})
    kind = topology.keywords()
    _work.start_device(mapping.device)
    goal = mass.target()

    def map_one(mesh: Path | None, files: tuple[Path, Path | None]) -> tuple[dict, str]:
        assert mesh is not None
        target, report_target = files
        sound = _work.read_sound_mesh(mesh, repair, any_surface=kind is not None, smoothing=smoothing)
        structure = structure_of(mesh)
        _work.require_own_hemisphere(structure, target)
        weights, at = weights_of(mass, sound, structure)
        asked = {"weights": weights, "weights_at": at, "target": goal}
        result = make_map(sound.surface, mapping, quiet=printing.quiet, any_surface=kind, **asked)
        require_bijective(result)
        if topology.idle(result):
            say(f"warning: {mesh}: closed and without handles, so that options for holes, handles and parts do nothing")
        if up is not None or front is not None:
            result = standing(result, None, up, front)
        if structure is not None:
            result.report["structure"] = structure
        if (volume := volume_geometry_of(mesh)) is not None:
            result.report["volume_geometry"] = volume
        result, joined = with_copies(result, sound)
        with staged(target) as file:
            save(result, file, like=mesh, radius=radius, beside=beside, joined=joined)
        if report_target is not None:
            read = {"path": str(mesh), "notes": sound.notes}
            write_text(report_target, _work.report_text({"input": read, **result.report, "history": result.history}))
        if printing.verbose:
            _work.say_stages(result)
        facts = _work.facts_of(result, target, report_target)
        return facts, _work.summary(facts)

    _work.show_each(meshes, zip(targets, reports, strict=True), map_one, printing)


def weights_of(mass: Mass, sound: Input, structure: str | None) -> tuple[NDArray[np.float64] | None, WeightsAt]:
    """Read weights of a file's mesh, and reorder them where it was repaired or copies of its vertices were joined.

    Args:
        mass: names the file of weights.
        sound: the mesh.
        structure: the part of the brain that it is, where its file says it.

    Returns:
        The weights of the mesh's vertices or triangles, None where no file is named, and which of them.

    Raises:
        OmtwarpError: the file holds no numbers, or not as many as the mesh's file has vertices or triangles; or parts
            of the repaired mesh have no weights.
    """
    if mass.weights is None:
        return None, mass.weights_at
    from omtwarp.measures import weights_belong_to
    from omtwarp.mesh.data import read_data

    columns = read_data(mass.weights, structure).values
    if columns.shape[1] != 1:
        raise OmtwarpError(f"{mass.weights}: {columns.shape[1]} numbers for every vertex or face, not one")
    weights, file = columns[:, 0].astype(float), sound.mesh.file
    belong = weights_belong_to(weights.shape, len(file.vertices), len(file.faces), mass.weights_at)
    origins = sound.surface.origins
    if origins is None:
        return weights, belong
    origin = origins.vertex_origin if belong is WeightsAt.VERTICES else origins.face_origin
    if added := int((origin < 0).sum()):
        raise OmtwarpError(f"'{mass.weights}' has no weights for the {added} parts that --repair added to the mesh")
    return weights[origin], belong


def with_copies(result: MapResult, sound: Input) -> tuple[MapResult, JoinedMesh | None]:
    """Return a map that says which vertex each of the file's is, and what was read where a mesh has those alone.

    Args:
        result: the map.
        sound: what was mapped.
    """
    import numpy as np

    joined, own = sound.mesh, sound.surface
    if own.origins is not joined:
        return result, None  # no copies were joined, or the mesh was repaired
    if np.array_equal(result.vertices[: own.vertex_count], own.vertices):
        result = result.with_arrays({"vertex_of_file": joined.vertex_of_file})
    return result, joined if np.array_equal(result.faces, own.faces) else None


def save(
    result: MapResult, file: Path, *, like: Path, radius: float, beside: bool = False, joined: JoinedMesh | None = None
) -> None:
    """Write a map as .npz, or its sphere as a mesh; of a map to a torus the textured surface, or a ring torus.

    Args:
        result: the map.
        file: where to.
        like: the mesh that was mapped.
        radius: of the sphere, as a mesh.
        beside: write the surface, with the sphere at its vertices.
        joined: ``like`` where copies of its vertices along seams were joined: a mesh is written with the copies.
    """
    import numpy as np

    from omtwarp.mesh.write import write_mesh

    faces, back = (result.faces, np.asarray) if joined is None else (joined.file.faces, joined.restrict)
    if file.suffix.lower() == ".npz":
        result.save(file)
    elif result.domain == Domain.TORUS and file.suffix.lower() == ".glb":
        omtwarp.texture(result, pattern="checker").export(file)
    elif result.domain == Domain.TORUS:
        write_mesh(file, radius * result.ring(), result.faces, like=like)
    elif beside:
        places = dict(zip(("px", "py", "pz"), radius * back(image_of(result)).T, strict=True))
        write_mesh(file, back(result.vertices), faces, beside=places)
    else:
        write_mesh(file, radius * back(image_of(result)), faces, spherical=True, like=like)


def image_of(result: MapResult) -> NDArray:
    """Return the image of the surface as points in space, shape [V, 3]: the sphere, or the disk at height 0."""
    import numpy as np

    disk = result.disk
    return result.sphere if disk is None else np.concatenate([disk, np.zeros((len(disk), 1))], axis=1)


UP, FRONT, VIEW = "z", "-y", (40.0, 15.0)
"""The creature stands on its feet and looks past the viewer's right shoulder."""


NAMES = ("creature.ply", "map.npz", "report.json", "globe.glb", "globe.png", "circles.png", "comparison.png")


def run_demo(
    *,
    output: Annotated[Path, output_option()] = Path("out"),
    faces: Annotated[int, Typed(bounds=(2000, 2000000))] = 20000,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Make a shape, map it, texture it and draw it: mesh, map, report, textured model and pictures.

    Examples:
        omtwarp demo -o out

    Options:
        output (DIRECTORY): Folder of the results.
        faces: Roughly how many faces the shape has.
    """
    _work.start_device(device)
    make_folder(output)
    with folder_of_results(output, *NAMES):
        _make(output, faces, device, printing)


def _make(output: Path, faces: int, device: str, printing: Printing) -> None:
    """Make the files of the demo; arguments are those of the command."""
    from omtwarp.mesh.shapes import demo_shape
    from omtwarp.mesh.write import write_mesh
    from omtwarp.render import comparison
    from omtwarp.texturing import rasterize

    files = [output / name for name in NAMES]
    for file in files:
        check_output(file)
    mesh_file, map_file, report_file, model_file, globe_file, circles_file, comparison_file = files
    start = time.perf_counter()

    def notify(text: str) -> None:
        if not printing.quiet and not printing.as_json:
            print(f"{time.perf_counter() - start:6.1f} s  {text}", flush=True)

    surface = demo_shape(faces)
    write_mesh(mesh_file, surface.vertices, surface.faces)
    notify(f"{mesh_file}: a creature of {surface.face_count} faces")
    result = make_map(surface, MapOptions(device=device), quiet=printing.quiet)
    result.save(map_file)
    write_text(report_file, _work.report_text({**result.report, "history": result.history}))
    if printing.verbose:
        _work.say_stages(result)
    facts = _work.facts_of(result, map_file, report_file)
    notify(_work.summary(_work.facts_of(result, map_file)))
    globe = omtwarp.texture(result, pattern="globe", rotate=[0.0, -90.0, 0.0], device=device)  # Africa on its flank
    globe.export(model_file)
    notify(f"{model_file}: a globe pulled back to it")
    circles = omtwarp.texture(result, pattern="circles", device=device)
    for file_to_be, textured in ((globe_file, globe), (circles_file, circles)):
        omtwarp.preview(textured.trimesh(), file_to_be, up=UP, front=FRONT, views=VIEW, device=device)
        notify(f"{file_to_be}")
    circles_picture = rasterize("circles", 2048, device=device)
    comparison(result, comparison_file, image=circles_picture, up=UP, front=FRONT, views=VIEW, device=device)
    notify(f"{comparison_file}: the conformal and the area-preserving map")
    if printing.as_json:
        print(_work.report_text(facts | {"output": str(output), "files": [str(file) for file in files]}), end="")
