"""Area-preserving, flip-free maps from closed genus-0 surfaces to the sphere, and textures through them.

>>> import omtwarp
>>> result = omtwarp.map_to_sphere(mesh)            # a trimesh.Trimesh, or (vertices, faces)  # doctest: +SKIP
>>> omtwarp.texture(result, image).export("it.glb")  # doctest: +SKIP

Names are imported at their first use, so that ``import omtwarp`` is fast.
"""

from __future__ import annotations

import importlib
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING

from omtwarp.maps import Displayable as _Displayable

# The module that every public name comes from; `shapes` is itself a module.
_PUBLIC = {
    "Defect": "omtwarp.mesh.validate",
    "MapResult": "omtwarp.maps.result",
    "OmtwarpError": "omtwarp.errors",
    "OmtwarpWarning": "omtwarp.errors",
    "Surface": "omtwarp.mesh.surface",
    "TargetDensity": "omtwarp.measures",
    "Material": "omtwarp.texturing",
    "PaintedMesh": "omtwarp.texturing",
    "align": "omtwarp.alignment",
    "TorusMap": "omtwarp.maps.torus_map",
    "barycentric_map": "omtwarp.baselines",
    "certify": "omtwarp.metrics.certificate",
    "check": "omtwarp.mesh.validate",
    "conformal_map": "omtwarp.conformal",
    "distortion": "omtwarp.metrics",
    "film": "omtwarp.render.films",
    "harmonic_points": "omtwarp.conformal",
    "hierarchical_embedding": "omtwarp.start.hierarchical",
    "map_optimality": "omtwarp.metrics.optimality",
    "map_surface": "omtwarp.mapping.any_surface",
    "map_to_sphere": "omtwarp.mapping.pipeline",
    "mobius_centring": "omtwarp.conformal",
    "moser_map": "omtwarp.moser",
    "optimal_map": "omtwarp.optimal",
    "optimal_transport": "omtwarp.transport.flow",
    "optimality": "omtwarp.metrics.optimality",
    "paint": "omtwarp.texturing",
    "paper_flow": "omtwarp.transport.paper",
    "preview": "omtwarp.render",
    "read_mesh": "omtwarp.mesh.read",
    "read_painted_mesh": "omtwarp.texturing",
    "refine_map": "omtwarp.optimal.refinement",
    "register": "omtwarp.registration",
    "repair": "omtwarp.mesh.repair",
    "resample": "omtwarp.resampling",
    "texture": "omtwarp.texturing",
    "transfer_texture": "omtwarp.transfer",
    "transport_cost": "omtwarp.transport.cost",
    "untangle": "omtwarp.untangling.untangle",
    "unwrap_uv": "omtwarp.texturing",
    "weighted_surface": "omtwarp.measures",
    "write_report": "omtwarp.reporting",
}

_MODULES = {"benchmark": "omtwarp.benchmark", "shapes": "omtwarp.mesh.shapes"}

if TYPE_CHECKING:
    __version__: str
    from omtwarp import benchmark as benchmark
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
    from omtwarp.maps.torus_map import TorusMap as TorusMap
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
    from omtwarp.render import preview as preview
    from omtwarp.render.films import film as film
    from omtwarp.reporting import write_report as write_report
    from omtwarp.resampling import resample as resample
    from omtwarp.start.hierarchical import hierarchical_embedding as hierarchical_embedding
    from omtwarp.texturing import (
        Material as Material,
        PaintedMesh as PaintedMesh,
        paint as paint,
        read_painted_mesh as read_painted_mesh,
        texture as texture,
        unwrap_uv as unwrap_uv,
    )
    from omtwarp.transfer import transfer_texture as transfer_texture
    from omtwarp.transport.cost import transport_cost as transport_cost
    from omtwarp.transport.flow import optimal_transport as optimal_transport
    from omtwarp.transport.paper import paper_flow as paper_flow
    from omtwarp.untangling.untangle import untangle as untangle

__all__ = ["__version__", *_PUBLIC, *_MODULES]  # noqa: PLE0604 (ruff cannot see that all are texts)


def _viewers() -> _ModuleType:
    """Return the module that displays maps, loaded when the first is displayed."""
    from omtwarp.reporting import notebook

    return notebook


_Displayable.viewers = _viewers


def __getattr__(name: str) -> object:
    if name == "__version__":
        value: object = importlib.import_module("omtwarp.version").package_version()
    elif name in _PUBLIC:
        value = getattr(importlib.import_module(_PUBLIC[name]), name)
    elif name in _MODULES:
        value = importlib.import_module(_MODULES[name])
    else:
        raise AttributeError(f"module 'omtwarp' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
