"""A finished map, and its file."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import staged
from omtwarp.metrics.distortion import Distortion, distortion

Array = NDArray[np.float64]

# What an .npz of a map holds. The first five are always there; the others where their stage was run.
REQUIRED = ("vertices", "faces", "sphere", "conformal", "density")
OPTIONAL = ("face_density", "moser", "transported")


@dataclass(frozen=True, eq=False)
class MapResult:
    """A surface and its map to the unit sphere, in the order of the input.

    Attributes:
        vertices: the surface as given, float64, shape [V, 3].
        faces: int32, shape [F, 3].
        sphere: the final map, unit vectors, float64, shape [V, 3].
        conformal: the map transport started from (conformal, or its substitute: see ``report``), shape [V, 3].
        density: μ at the vertices, area on the surface over area on the sphere under ``conformal``, shape [V].
        face_density: μ of the triangles, shape [F].
        moser: the initial mass-preserving map, shape [V, 3], where it was made.
        transported: the optimal map before refinement, shape [V, 3], where it was made.
        history: one record per iteration of the transport flow: ``iteration``, ``cost``, ``curl``, ...
        report: everything worth knowing about how the map was made, ready for JSON.
    """

    vertices: Array
    faces: NDArray[np.int32]
    sphere: Array
    conformal: Array
    density: Array
    face_density: Array | None = None
    moser: Array | None = None
    transported: Array | None = None
    history: list[dict[str, Any]] = field(default_factory=list)
    report: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"MapResult({len(self.vertices)} vertices, {len(self.faces)} faces, {self.distortion()})"

    def distortion(self, stage: str = "sphere") -> Distortion:
        """Distortion of the final map, or of a stage: ``conformal``, ``moser`` or ``transported``.

        Raises:
            OmtwarpError: the stage was not run.
        """
        points = getattr(self, stage, None) if stage in ("sphere", "conformal", "moser", "transported") else None
        if points is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
        return distortion(self.vertices, self.faces, points)

    @property
    def bijective(self) -> bool:
        """Whether the map was certified free of flips and of degree 1."""
        return bool(self.report.get("certificate", {}).get("bijective", False))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as ``.npz``: arrays of the attributes' names, and the report as JSON text under ``report``.

        Raises:
            OmtwarpError: the file cannot be written; nothing is left of it.
        """
        target = Path(path)
        arrays: dict[str, Any] = {}
        for name in REQUIRED + OPTIONAL:
            if getattr(self, name) is not None:
                arrays[name] = getattr(self, name)
        arrays["report"] = np.array(json.dumps(self.report | {"history": self.history}))
        # Given a name, NumPy would add a suffix to it.
        with staged(target) as file, open(file, "wb") as stream:
            np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MapResult:
        """Read a map written by :meth:`save`.

        Raises:
            OmtwarpError: the file is missing, or is no map.
        """
        source = Path(path)
        try:
            with np.load(source, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
        except FileNotFoundError:
            raise OmtwarpError(f"'{source}' does not exist") from None
        except PermissionError as error:
            raise OmtwarpError(f"'{source}' cannot be read: {error.strerror}") from error
        except (OSError, ValueError, EOFError, KeyError) as error:
            raise OmtwarpError(f"'{source}' is not a map: make one with 'omtwarp map MESH -o MAP.npz'") from error
        except Exception as error:  # zipfile and zlib raise kinds of their own on a damaged file
            raise OmtwarpError(f"'{source}' is damaged: make it again with 'omtwarp map'") from error
        missing = [name for name in REQUIRED if name not in arrays]
        if missing:
            raise OmtwarpError(f"'{source}' is not a map: it has no '{missing[0]}'")
        fields: dict[str, Any] = {}
        vertex_count, face_count = (len(np.atleast_1d(arrays[name])) for name in ("vertices", "faces"))
        for name in REQUIRED + OPTIONAL:
            if name in arrays:
                shape = {"faces": (face_count, 3), "density": (vertex_count,), "face_density": (face_count,)}
                kinds = "iu" if name == "faces" else "iuf"
                wanted = shape.get(name, (vertex_count, 3))
                if arrays[name].dtype.kind not in kinds or arrays[name].shape != wanted:
                    raise OmtwarpError(f"'{source}' is not a map: '{name}' is not an array of numbers, shape {wanted}")
                fields[name] = arrays[name].astype(np.int32 if name == "faces" else np.float64)
        if face_count and (arrays["faces"].min() < 0 or arrays["faces"].max() >= vertex_count):
            raise OmtwarpError(f"'{source}' is not a map: its faces name vertices that it does not have")
        try:
            report = json.loads(str(arrays["report"])) if "report" in arrays else {}
        except ValueError:
            report = {}
        if not isinstance(report, dict):
            report = {}
        return cls(**fields, history=report.pop("history", []), report=report)
