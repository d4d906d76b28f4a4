"""Average surfaces that other packages install, in one frame, to register to and to carry data to.

The sphere of every template is that of FreeSurfer's fsaverage. The vertices of fs_LR lie on it where HCP's pair of
spheres has them, so that fsaverage to fs_LR and back are resamplings like all others.
"""

import os
import re
import tomllib
from collections.abc import Iterator, Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from omtwarp.errors import OmtwarpError
from omtwarp.location import Locator
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.read import read_mesh
from omtwarp.options import Side
from omtwarp.spheres import SphereGrid, mesh_grid, named_grid

FOLDER = "OMTWARP_TEMPLATES"
"""The variable of the environment that names folders to look in first."""

_TABLES = tomllib.loads((files("omtwarp.resampling") / "averages.toml").read_text("utf-8"))
SURFACES, PACKAGES = _TABLES["surfaces"], _TABLES["packages"]


def is_average(name: str) -> bool:
    """Return whether a text is the name of a template with its hemisphere, such as ``fsaverage5-left``."""
    return re.fullmatch(rf"({'|'.join(SURFACES)})-(left|right)", name) is not None


def with_side(name: str, side: str | None) -> str:
    """Return the name of a template with its hemisphere; what names no template, or has it, is returned as it is.

    Args:
        name: any text.
        side: ``left`` or ``right``, or a structure of the brain such as ``CortexLeft``; None where it is not known.

    Raises:
        OmtwarpError: it is not known which hemisphere, or the text names the other one.
    """
    word = {"CortexLeft": Side.LEFT, "CortexRight": Side.RIGHT}.get(side or "", side)
    if is_average(name) and word in tuple(Side) and not name.endswith(f"-{word}"):
        raise OmtwarpError(f"a {word} hemisphere, and '{name}': take the template of the same hemisphere")
    if name not in SURFACES:
        return name
    if word not in tuple(Side):
        raise OmtwarpError(f"'{name}' has two hemispheres: use {name}-left or {name}-right")
    return f"{name}-{word}"


def average_surface(name: str) -> Floats:
    """Return the vertices of a template's surface, which are those of its sphere, shape [N, 3].

    Args:
        name: as :func:`is_average` has it.

    Raises:
        OmtwarpError: it is not installed.
    """
    return read_mesh(_require(name, SURFACES[name.split("-", maxsplit=1)[0]], "surface")).vertices


def average_sphere(name: str) -> SphereGrid:
    """Return a template's sphere; arguments and errors as of :func:`average_surface`."""
    base = name.split("-", maxsplit=1)[0]
    if base != "fsLR32k":
        return named_grid(base)
    file = _first(name, _TABLES["spheres"]["on_fsaverage"])
    if file is not None:
        mesh = read_mesh(file)
        return mesh_grid(mesh.vertices, mesh.faces, name)
    spheres = (_TABLES["spheres"][which] for which in ("own", "of_fsaverage"))
    own, theirs = (read_mesh(_require(name, names, "sphere")) for names in spheres)
    moved, grid = mesh_grid(theirs.vertices, theirs.faces, name), named_grid("fsaverage")
    unit = mesh_grid(own.vertices, own.faces, name)
    there = Locator(moved.points, moved.triangles, device="cpu").find(unit.points)
    return mesh_grid(there.on_sphere(moved.triangles, grid.points), own.faces, name)


def _require(name: str, names: Sequence[str], what: str) -> Path:
    file = _first(name, names)
    if file is None:
        ways = _TABLES["brought_by"][name.split("-", maxsplit=1)[0]]
        raise OmtwarpError(
            f"the {what} of '{name}' is not installed: {ways}, or let {FOLDER} name the folder of "
            f"'{_filled(name, names[0])}'"
        )
    return file


def _first(name: str, names: Sequence[str]) -> Path | None:
    """Return the first file with one of these names that there is, None if there is none."""
    places = (folder / _filled(name, one) for folder in _folders() for one in names)
    return next((place for place in places if place.is_file()), None)


def _filled(name: str, pattern: str) -> str:
    side = name.split("-")[1]
    return pattern.format(side=side, h=side[0], H=side[0].upper())


def _folders() -> Iterator[Path]:
    """Yield where templates may be: the folder that the user names, packages, and what FreeSurfer and others keep."""
    variables = FOLDER, "SUBJECTS_DIR", "NILEARN_SHARED_DATA", "NILEARN_DATA", "TEMPLATEFLOW_HOME"
    for value in (os.environ.get(variable) for variable in variables):
        yield from map(Path, value.split(os.pathsep) if value else ())
    for package, below in PACKAGES.items():
        spec = find_spec(package)
        for place in (spec.submodule_search_locations if spec else None) or ():
            yield Path(place) / below
    yield from (Path.home() / "nilearn_data", Path.home() / ".cache" / "templateflow")
