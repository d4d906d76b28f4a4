"""``omtwarp check``: what is wrong with a mesh, and how to repair it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import omtwarp
from omtwarp.commands._options import Argument, Printing, output_option
from omtwarp.commands._streams import input_file, say, step_times
from omtwarp.commands._work import of_a_map, outputs_of, show_each
from omtwarp.errors import OmtwarpError, with_options
from omtwarp.files.output import check_output

if TYPE_CHECKING:
    from numpy.typing import NDArray


def run_check(
    *,
    meshes: Annotated[list[Path], Argument(file=input_file)],
    repair: bool = False,
    output: Annotated[Path | None, output_option(".ply")] = None,
    printing: Printing,
) -> None:
    """List what keeps meshes from being mapped to the sphere.

    The exit status is 0 if nothing does.

    Examples:
        omtwarp check bunny.ply
        omtwarp check *.ply --json
        omtwarp check broken.ply --repair -o repaired.ply

    Options:
        repair: Repair the mesh, and list what was done.
        output: Write the repaired mesh.
        meshes (MESH): Closed triangle meshes of any format; - is standard input.
    """
    from omtwarp.mesh.write import SUFFIXES

    if output is not None and not repair:
        raise OmtwarpError("--output is for the repaired mesh: it needs --repair")
    targets = outputs_of(meshes, output, ".ply")
    for target in targets:
        check_output(target, SUFFIXES, *meshes)

    def examine(mesh: Path | None, target: Path | None) -> tuple[dict, str]:
        assert mesh is not None
        facts = facts_of(mesh, repair, target, verbose=printing.verbose)
        return facts, "\n".join(lines_about(facts))

    def failure(facts: Mapping) -> str:
        count = len(facts["defects"])
        if not count:
            return ""
        saved = f"; what could be repaired was saved as '{facts['output']['path']}'" if "output" in facts else ""
        left, where = ((" left" if repair else ""), ("" if printing.as_json or printing.quiet else ", see above"))
        return f"{facts['mesh']}: {count} kind{'s' * (count > 1)} of defect{left}{where}{saved}"

    show_each(meshes, targets, examine, printing, failure)


def facts_of(mesh: Path, repair: bool, target: Path | None, *, verbose: bool) -> dict:
    """List the defects of a mesh, its repairs, and what may make its map worse, ready for JSON.

    The repaired mesh is written where a target is given.

    Args:
        mesh: the file.
        repair: whether to repair it.
        target: where the repaired mesh goes.
        verbose: whether to say how long every step took.

    Raises:
        OmtwarpError: the file cannot be read, or the repaired mesh cannot be written.
    """
    from omtwarp.mapping.verdict import foretell
    from omtwarp.mesh.read import read_joined_mesh
    from omtwarp.mesh.write import write_mesh

    with step_times(verbose) as done:
        given = read_joined_mesh(mesh, together=True)
        done("read")
        vertices, faces = given.vertices, given.faces
        defects = before = omtwarp.check(vertices, faces)
        done("check")
        facts: dict = {"mesh": str(mesh), "vertices": len(vertices), "faces": len(faces)}
        facts |= {"notes": [*of_a_map(mesh), *given.notes], "repairs": []}
        if repair and defects:
            from omtwarp.mesh.repair import NOTED_LOSS

            repaired = omtwarp.repair(vertices, faces)
            facts["repairs"] = list(repaired.actions)
            if repaired.loss > NOTED_LOSS:
                say(f"{mesh}: {repaired.actions[-1]}")
            vertices, faces = repaired.vertices, repaired.faces
            defects = omtwarp.check(vertices, faces)
            facts["defects_before"] = [{"kind": defect.kind, "text": with_options(str(defect))} for defect in before]
            done("repair")
        facts["defects"] = [{"kind": defect.kind, "text": with_options(str(defect))} for defect in defects]
        facts["options"] = options_text(vertices, faces, defects)
        facts["mappable"] = not defects
        findings = [] if defects else foretell(omtwarp.Surface(vertices, faces))
        facts["warnings"] = [finding.to_dict() | {"text": with_options(str(finding))} for finding in findings]
        done("foretell")
    if target is not None:
        write_mesh(target, vertices, faces)
        facts["output"] = {"path": str(target), "vertices": len(vertices), "faces": len(faces)}
        with suppress(OmtwarpError):  # of a picture that cannot be read
            painted = omtwarp.read_painted_mesh(mesh)
            if painted.uv is not None or painted.vertex_colors is not None:
                say(f"warning: {target}: without the colours and texture coordinates of {mesh}")
    return facts


def lines_about(facts: dict) -> list[str]:
    """Describe a mesh for readers, one fact on each line."""
    from omtwarp.mapping.verdict import MAX_AREA_DISTORTION, NEEDLES

    lines = [f"{facts['mesh']}: {facts['vertices']} vertices, {facts['faces']} faces"]
    lines += [f"  note: {note}" for note in facts["notes"]]
    repaired = "defects_before" in facts
    shown = facts["defects_before"] if repaired else facts["defects"]
    lines += [f"  {defect['kind']}: {defect['text']}" for defect in shown]
    lines += [f"  repair: {action}" for action in facts["repairs"]]
    lines += [f"  left: {defect['text']}" for defect in facts["defects"] if repaired]
    lines += [f"  option {text}" for text in facts["options"]]
    if "output" in facts:
        written = facts["output"]
        lines.append(f"{written['path']}: {written['vertices']} vertices, {written['faces']} faces")
    if facts["mappable"]:
        lines.append("  closed, manifold, oriented outward, one component, genus 0: it can be mapped")
    for finding in facts["warnings"]:
        areas = f"leave area distortion above {MAX_AREA_DISTORTION:g}"
        may = "end before its optimum" if finding["kind"] == NEEDLES else areas
        lines.append(f"  warning: the map may {may}: {finding['text']}")
    return lines


def options_text(vertices: NDArray, faces: NDArray, defects: list[omtwarp.Defect]) -> list[str]:
    """List the options of ``omtwarp map`` for a mesh that is no sphere; none for other defects."""
    from omtwarp.topology.kind import MAPPABLE, options_for, parts_of

    if not defects or any(defect.kind not in MAPPABLE for defect in defects):
        return []
    try:
        return [with_options(text) for text in options_for(parts_of(vertices, faces))]
    except OmtwarpError:  # a boundary that touches itself, which no option takes
        return []
