"""Finished maps and their files; here is how they show themselves in notebooks and in viewers of other programs."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, ClassVar

from omtwarp.options import PatternLike

if TYPE_CHECKING:
    import polyscope
    import pyvista
    from PIL.Image import Image


class Displayable:
    """The ways to display a map; nothing is computed before one of these is called.

    Attributes:
        viewers: returns :mod:`omtwarp.reporting.notebook`. That is built on maps, so that the package sets it, not this
            module.
    """

    viewers: ClassVar[Callable[[], ModuleType]]

    def _repr_html_(self) -> str:
        """Return the view that Jupyter, JupyterLab and VS Code show of a map at the end of a cell."""
        return Displayable.viewers().notebook_view(self)

    def plot(self, *, pattern: PatternLike = "circles", size: tuple[int, int] = (640, 480), **options: object) -> Image:
        """Draw the map: the surface, with a pattern carried to it.

        Args:
            pattern: ``circles``, ``puzzle``, ``globe`` or ``checker``; left out where ``scalar`` or ``image`` is given.
                On a torus ``circles`` or ``checker``.
            size: width and height in pixels.
            options: those of :func:`omtwarp.preview`, such as ``views="six"`` or ``image="earth.png"``.

        Returns:
            A PIL image, which a notebook shows.

        Raises:
            OmtwarpError: an option has an invalid value.
        """
        return Displayable.viewers().plot(self, pattern=pattern, size=size, **options)

    def to_pyvista(self) -> pyvista.PolyData:
        """Convert the map for PyVista: ``result.to_pyvista().plot(scalars="area_ratio")``.

        Returns:
            A ``pyvista.PolyData`` of the surface, with every stage's map as vectors at its points, and ``area_ratio``
            (on the sphere over on the surface, 1 is perfect) and ``angle`` (2 is perfect) of its triangles.

        Raises:
            OmtwarpError: PyVista is not installed.
        """
        return Displayable.viewers().to_pyvista(self)

    def to_polyscope(self, name: str = "surface") -> polyscope.SurfaceMesh:
        """Register the map with Polyscope: surface and sphere side by side; ``polyscope.show()`` opens the window.

        Args:
            name: of the surface among Polyscope's structures; the sphere is called ``NAME's sphere``.

        Returns:
            Polyscope's surface mesh of the surface, with area and angle distortion as quantities of its faces.

        Raises:
            OmtwarpError: Polyscope is not installed.
        """
        return Displayable.viewers().to_polyscope(self, name)
