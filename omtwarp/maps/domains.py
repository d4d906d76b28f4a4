"""Where a map goes, asked of anything that is given as one, without loading what measures maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeGuard

from omtwarp.maps import Displayable
from omtwarp.options import Domain

if TYPE_CHECKING:
    from omtwarp.maps.result import MapResult


def is_torus_map(subject: object) -> TypeGuard[MapResult]:
    """Return whether something is a map, and its domain a torus."""
    return isinstance(subject, Displayable) and getattr(subject, "domain", None) == Domain.TORUS
