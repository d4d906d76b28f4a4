"""Area-preserving, flip-free maps from closed genus-0 surfaces to the sphere, and textures through them.

>>> import omtwarp
>>> result = omtwarp.map_to_sphere(mesh)            # a trimesh.Trimesh, or (vertices, faces)  # doctest: +SKIP
>>> omtwarp.texture(result, image).export("it.glb")  # doctest: +SKIP

Names are imported at their first use, so that ``import omtwarp`` is fast.
"""

from __future__ import annotations

import ast as _ast
import importlib as _importlib
import inspect as _inspect
import sys as _sys
from collections.abc import Callable as _Callable
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING

from omtwarp.maps import Displayable as _Displayable

if TYPE_CHECKING:
    __version__: str
    from omtwarp.alignment import align as align
    from omtwarp.baselines import barycentric_map as barycentric_map
    from omtwarp.conformal import (
        conformal_map as conformal_map,
        harmonic_points as harmonic_points,
        mobius_centring as mobius_centring,
    )
    from omtwarp.errors import OmtwarpError as OmtwarpError, OmtwarpWarning as OmtwarpWarning
    from omtwarp.mapping.any_surface import map_surface as map_surface
    from omtwarp.mapping.pipeline import map_to_sphere as map_to_sphere
    from omtwarp.maps.result import MapResult as MapResult
    from omtwarp.measures import TargetDensity as TargetDensity, weighted_surface as weighted_surface
    from omtwarp.mesh import shapes as shapes
    from omtwarp.mesh.read import read_mesh as read_mesh
    from omtwarp.mesh.repair import repair as repair
    from omtwarp.mesh.surface import Surface as Surface
    from omtwarp.mesh.validate import Defect as Defect, check as check
    from omtwarp.metrics import distortion as distortion
    from omtwarp.metrics.certificate import certify as certify
    from omtwarp.metrics.optimality import map_optimality as map_optimality, optimality as optimality
    from omtwarp.moser import moser_map as moser_map
    from omtwarp.optimal import optimal_map as optimal_map
    from omtwarp.optimal.refinement import refine_map as refine_map
    from omtwarp.registration import register as register
    from omtwarp.render.films import film as film
    from omtwarp.render.pictures import preview as preview
    from omtwarp.reporting.page import write_report as write_report
    from omtwarp.resampling import resample as resample
    from omtwarp.start.hierarchical import hierarchical_embedding as hierarchical_embedding
    from omtwarp.texturing.export import Material as Material
    from omtwarp.texturing.painted import PaintedMesh as PaintedMesh
    from omtwarp.texturing.painter import paint as paint
    from omtwarp.texturing.read import read_painted_mesh as read_painted_mesh
    from omtwarp.texturing.textured import texture as texture
    from omtwarp.texturing.unwrap import unwrap_uv as unwrap_uv
    from omtwarp.transfer import transfer_texture as transfer_texture
    from omtwarp.transport.cost import transport_cost as transport_cost
    from omtwarp.transport.flow import optimal_transport as optimal_transport
    from omtwarp.transport.paper import paper_flow as paper_flow
    from omtwarp.untangling.untangle import untangle as untangle


def _at_first_use(package: str) -> tuple[list[str], _Callable[[str], object], _Callable[[], list[str]]]:
    """Return the names of a package, a function that imports one of them, and one that lists them.

    The names, and the modules that they come from, are those of the package's block for type checkers: its text is
    there, as that of kernels, which Warp reads, has to be.
    """
    text = _inspect.getsource(_sys.modules[package])
    block = next(node for node in _ast.parse(text).body if isinstance(node, _ast.If))
    imports = [node for node in block.body if isinstance(node, _ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def imported(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        home = vars(_importlib.import_module(homes[name]))
        return home[name] if name in home else _importlib.import_module(f"{homes[name]}.{name}")

    return [*homes], imported, lambda: sorted(homes)


_names, _imported, _ = _at_first_use(__name__)
__all__ = ["__version__", *_names]  # noqa: PLE0604 (ruff cannot see that all are texts)


def _viewers() -> _ModuleType:
    """Return the module that displays maps, loaded when the first is displayed."""
    from omtwarp.reporting import notebook

    return notebook


_Displayable.viewers = _viewers


def __getattr__(name: str) -> object:
    if name == "__version__":
        value: object = _importlib.import_module("omtwarp.version").package_version()
    else:
        value = _imported(name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
