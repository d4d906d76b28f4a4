"""A closed triangle mesh with the quantities that stages need, computed once and cached."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import sent
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import arrays
from omtwarp.mesh.arrays import ROUND_OFF, Floats, Ints, cross, edge_keys, norms, real_numbers, whole_numbers
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.validate import MeshLike, mesh_arrays, require_valid, unit_coordinates

Kind = TypeVar("Kind")
SPHERE_AREA = 4.0 * np.pi


class Surface:
    """Vertices and faces as the caller gave them, and quantities derived from them.

    The order of vertices and faces is the caller's. The arrays are copies that cannot be written to, since everything
    derived from them is kept. The class does not check the mesh: see :func:`omtwarp.mesh.surface.as_surface`.

    Every stage takes :attr:`face_areas` as the mass of a triangle, which is the area that its image is to have. These
    are the triangles' own areas unless ``areas`` gives another measure.

    Args:
        vertices: positions, shape [V, 3], in any unit.
        faces: vertex indices, shape [F, 3], counter-clockwise seen from outside.
        areas: the measure of every triangle, positive, shape [F], in any unit; its own area where not given.

    Attributes:
        vertices: float64, shape [V, 3], in the units of the input.
        faces: int32, shape [F, 3], counter-clockwise seen from outside.
        checked: whether the mesh was examined and can be mapped.
        origins: what its vertices and faces are in the input; None where their numbers are the same.

    Raises:
        OmtwarpError: the arrays are not of numbers, a corner is not among the vertices, or ``areas`` is not one
            positive, finite number per triangle.

    Example:
        >>> import numpy as np, omtwarp
        >>> surface = omtwarp.Surface([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]],
        ...                           [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
        >>> surface.vertex_count, surface.face_count
        (4, 4)
        >>> bool(np.isclose(surface.face_areas.sum(), 4 * np.pi))  # scaled to the unit sphere's area
        True
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, areas: ArrayLike | None = None):
        self.vertices: Floats = np.array(real_numbers(vertices, "vertices", (None, 3), finite=False))
        self.faces: Ints = whole_numbers(faces, "faces", (None, 3), below=len(self.vertices)).astype(np.int32)
        self.vertices.flags.writeable = self.faces.flags.writeable = False
        self.checked = False
        self.origins: Origins | None = None
        self._given_areas = None if areas is None else scaled_areas(areas, len(self.faces))
        self._sent: dict[str, dict[str, wp.array]] = {}
        self._kept: dict[str, object] = {}

    def with_areas(self, areas: ArrayLike) -> Surface:
        """Make the same surface with another measure; what depends on shape and connectivity alone is shared.

        Args:
            areas: the measure of every triangle, positive, shape [F], in any unit.

        Raises:
            OmtwarpError: ``areas`` is not one positive, finite number per triangle.

        Example:
            >>> import numpy as np, omtwarp
            >>> surface = omtwarp.shapes.icosphere(4)
            >>> heavier = surface.with_areas(surface.face_areas * np.linspace(1.0, 2.0, surface.face_count))
            >>> float(round(heavier.face_areas.sum() / (4 * np.pi), 12))
            1.0
        """
        other = Surface(self.vertices, self.faces, areas)
        other.__dict__.update({name: value for name, value in self.__dict__.items() if name in _UNWEIGHTED})
        for device, sent_there in self._sent.items():
            other._sent[device] = {name: array for name, array in sent_there.items() if name not in _WEIGHTED}
        return other

    @property
    def weighted(self) -> bool:
        """Whether triangles were given another measure than their own areas."""
        return self._given_areas is not None

    def __reduce__(self) -> tuple[object, ...]:  # without what is kept, which may be on a device
        return Surface, (self.vertices, self.faces), {k: vars(self)[k] for k in ("checked", "origins", "_given_areas")}

    def __repr__(self) -> str:
        return f"Surface({self.vertex_count} vertices, {self.face_count} faces)"

    @property
    def vertex_count(self) -> int:
        return len(self.vertices)

    @property
    def face_count(self) -> int:
        return len(self.faces)

    @property
    def moderate_vertices(self) -> Floats:
        """The vertices, times a power of two where squares of their coordinates would overflow or vanish, [V, 3]."""
        return arrays.in_range(self.vertices)

    @cached_property
    def scaled_vertices(self) -> Floats:
        """Vertices moved to their bounding box's centre and scaled so that the surface's area is 4π, shape [V, 3]."""
        unit = unit_coordinates(self.vertices)  # whose squares are in range at any scale of the input
        return unit * np.sqrt(SPHERE_AREA / triangle_areas(unit, self.faces).sum())

    @cached_property
    def own_areas(self) -> Floats:
        """Area of every triangle of the scaled surface, shape [F]; the sum is 4π."""
        return triangle_areas(self.scaled_vertices, self.faces)

    @cached_property
    def face_areas(self) -> Floats:
        """Measure of every triangle, shape [F]; the sum is 4π. Its own area unless another measure was given."""
        return self.own_areas if self._given_areas is None else self._given_areas

    @cached_property
    def vertex_areas(self) -> Floats:
        """A third of the measure of the triangles around every vertex, shape [V]; the sum is 4π."""
        return self.sum_to_vertices(self.face_areas) / 3.0

    def sum_to_vertices(self, per_face: Floats) -> Floats:
        """Sum a number per face, shape [F], over the faces around every vertex, shape [V]."""
        return sums_around(per_face, self.faces, self.vertex_count)

    @cached_property
    def face_neighbours(self) -> Ints:
        """The face across edge (k, k+1) of every face, shape [F, 3]; -1 where there is none."""
        order = self._sides
        if order is None:
            return face_neighbours(self.faces, self.vertex_count)
        # Corner c lies opposite to the edge that begins at the next corner.
        slot = order - order % 3 + (order + 1) % 3
        neighbours = np.empty(3 * self.face_count, dtype=np.int32)
        neighbours[slot[0::2]] = order[1::2] // 3
        neighbours[slot[1::2]] = order[0::2] // 3
        return neighbours.reshape(-1, 3)

    @cached_property
    def vertex_corners(self) -> tuple[Ints, Ints]:
        """Corners around every vertex as compressed rows: offsets [V + 1] and corners [3F].

        Corner ``c`` is corner ``c % 3`` of face ``c // 3``. Kernels gather over these rows instead of scattering with
        atomics, so that sums at vertices have one order and the same bits on every run and every device.
        """
        return transposed_rows(self.faces, self.vertex_count)

    @cached_property
    def edges(self) -> Ints:
        """Every undirected edge once, smaller vertex first, shape [E, 2], sorted."""
        order = self._sides
        keys = self._side_keys
        keys = np.unique(keys) if order is None else keys[order[0::2]]
        return np.stack([keys // self.vertex_count, keys % self.vertex_count], axis=1).astype(np.int32)

    @property
    def closed(self) -> bool:
        """Whether every edge has two triangles."""
        return self._sides is not None

    @cached_property
    def edge_corners(self) -> Ints:
        """The two corners that lie opposite to every edge of a closed surface, shape [E, 2].

        Raises:
            OmtwarpError: an edge does not have two triangles.
        """
        if self._sides is None:
            raise OmtwarpError("the surface is not closed and manifold: an edge does not have two triangles")
        return self._sides.reshape(-1, 2)

    @cached_property
    def side_corners(self) -> Ints:
        """The corners that lie opposite to every edge, shape [E, 2]; -1 for the second of an edge with one triangle.

        Raises:
            OmtwarpError: an edge has more than two triangles.
        """
        if self._sides is not None:
            return self.edge_corners
        order = np.argsort(self._side_keys, kind="stable").astype(np.int32)
        _, first, count = np.unique(self._side_keys[order], return_index=True, return_counts=True)
        if count.max() > 2:
            raise OmtwarpError("the surface is not manifold: an edge has more than two triangles")
        second = np.where(count == 2, order[np.minimum(first + 1, len(order) - 1)], -1)
        return np.stack([order[first], second], axis=1).astype(np.int32)

    def cached(self, name: str, make: Callable[[], Kind]) -> Kind:
        """Return what ``make`` computes from shape and connectivity, computed once under each name and kept.

        Solvers and others cache here what they derive from a surface, so that it lives as long as the surface and is
        shared by :meth:`with_areas`. It must not refer to the surface, nor depend on its measure.

        Args:
            name: of the object, and of the device that it is on, if any.
            make: computes it.
        """
        if name not in self._kept:
            self._kept[name] = make()
        return cast(Kind, self._kept[name])

    def on(self, device: str | wp.Device | None) -> SurfaceArrays:
        """Return the surface's arrays on a device, for kernels; each is copied there once."""
        where = resolve_device(device)
        return SurfaceArrays(self, where, self._sent.setdefault(str(where), {}))

    @property
    def _side_keys(self) -> NDArray[np.int64]:
        """A number for the undirected edge opposite to every corner, shape [3F]; it sorts as edges do."""
        return edge_keys(self.faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), self.vertex_count)

    @cached_property
    def _sides(self) -> Ints | None:
        """Corners in the order of the edges they lie opposite to, shape [3F]; None if edges do not come in twos."""
        keys = self._side_keys
        order = np.argsort(keys, kind="stable").astype(np.int32)
        ranked = keys[order]
        twos = len(keys) % 2 == 0 and np.array_equal(ranked[0::2], ranked[1::2])
        return order if twos and not np.any(ranked[2::2] == ranked[1:-1:2]) else None


# Arrays that depend on the measure of the triangles, and what a surface of another measure takes over.
_WEIGHTED = {"face_areas", "vertex_areas"}
_CACHED = {name for name, value in vars(Surface).items() if isinstance(value, cached_property)}
_UNWEIGHTED = {"checked", "origins", "_kept"} | _CACHED - _WEIGHTED


def scaled_areas(areas: ArrayLike, count: int) -> Floats:
    """Check a measure of triangles and scale it to the sum 4π, shape [F].

    Raises:
        OmtwarpError: it is not one positive, finite number per triangle, or the sum overflows.
    """
    given = real_numbers(areas, "the areas of triangles", (count,), positive=True)
    given = given / given.max()
    return given * (SPHERE_AREA / math.fsum(given))  # the same in any order of the triangles


def _on_device(name: str, dtype: type) -> property:
    """Return a property that is a surface's array of a name, on the device."""
    return property(lambda owner: owner._array(name, dtype))


class SurfaceArrays:
    """Arrays of a surface on a device; kernels read them. Made by :meth:`omtwarp.mesh.surface.Surface.on`.

    Each is copied when it is first used, and lives as long as the surface. On the CPU they are the surface's own
    arrays, without a copy.

    Args:
        surface: the surface, V vertices, F faces and E edges.
        device: a Warp device.
        known: what is there already, by name; more is added.
    """

    def __init__(self, surface: Surface, device: wp.Device, known: dict[str, wp.array]):
        self._surface, self._device, self._sent = surface, device, known

    def _array(self, name: str, dtype: type, part: int | None = None) -> wp.array:
        key = name if part is None else f"{name} {part}"
        if key not in self._sent:
            values = getattr(self._surface, name)
            self._sent[key] = sent(values if part is None else values[part], dtype, self._device)
        return self._sent[key]

    vertices = _on_device("moderate_vertices", wp.vec3d)
    """Positions, vec3d, shape [V], in the units of the input; times a power of two where those are extreme."""

    faces = _on_device("faces", wp.vec3i)
    """Corners of the triangles, vec3i, shape [F]."""

    face_areas = _on_device("face_areas", wp.float64)
    """Areas of the scaled triangles, float64, shape [F]."""

    vertex_areas = _on_device("vertex_areas", wp.float64)
    """A third of the areas around every vertex, float64, shape [V]."""

    face_neighbours = _on_device("face_neighbours", wp.vec3i)
    """The faces across the edges of every face, vec3i, shape [F]."""

    @property
    def vertex_corners(self) -> list[wp.array]:
        """Corners around every vertex as compressed rows, int32: offsets, shape [V + 1], and corners, shape [3F]."""
        return [self._array("vertex_corners", wp.int32, part) for part in range(2)]

    edges = _on_device("edges", wp.vec2i)
    """Every edge once, vec2i, shape [E]."""

    edge_corners = _on_device("side_corners", wp.vec2i)
    """The corners opposite to every edge, vec2i, shape [E]; -1 for the second of an edge with one triangle."""


def transposed_rows(stencil: Ints, count: int) -> tuple[Ints, Ints]:
    """Return, as compressed rows, the flat indices in ``stencil`` at which each of ``count`` nodes stands."""
    flat = stencil.ravel()
    offsets = np.zeros(count + 1, dtype=np.int32)
    np.cumsum(np.bincount(flat, minlength=count), out=offsets[1:])
    return offsets, np.argsort(flat, kind="stable").astype(np.int32)


def sums_around(per_face: Floats, faces: NDArray[np.integer], count: int) -> Floats:
    """Sum a number per face, shape [F], over the faces around every vertex, shape [count]."""
    return np.bincount(faces.ravel(), np.repeat(per_face, 3), count).astype(np.float64, copy=False)


def plane_areas(corners: Floats) -> Floats:
    """Return the signed areas of plane triangles, shape [F], from their corners [F, 3, 2]."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])


def triangle_areas(points: Floats, faces: NDArray[np.integer]) -> Floats:
    """Return the area of every flat triangle, shape [F]."""
    p0, p1, p2 = points.take(faces.T, axis=0)  # in a sixth of the time of points[faces.T]
    return 0.5 * norms(cross(p1 - p0, p2 - p0))


def vertex_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return the unit normals at vertices, shape [V, 3]: the mean of the faces' normals, weighted by area.

    They are zero where the faces around a vertex cancel or have no area.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    # Squares stay in range at any scale.
    scaled = (vertices - low) / max(float((high - low).max()), np.finfo(float).tiny)
    p0, p1, p2 = scaled.take(faces.T, axis=0)
    weighted = cross(p1 - p0, p2 - p0)
    return arrays.normalised(arrays.summed(np.repeat(weighted, 3, axis=0), faces.ravel(), len(vertices)))


def unit_normals(normals: Floats) -> Floats:
    """Scale normals to unit length.

    A zero normal becomes the direction of the z axis, as file formats require one.
    """
    units = arrays.normalised(normals)
    return np.where(norms(units)[:, None] > 0.5, units, (0.0, 0.0, 1.0))  # of none, the length is 0 or 1


def face_neighbours(faces: Ints, vertex_count: int) -> Ints:
    """Return the face across edge (k, k+1) of every face of an oriented manifold mesh, shape [F, 3].

    It is -1 at a boundary.
    """
    tail = faces.astype(np.int64).ravel()
    head = np.roll(faces, -1, axis=1).astype(np.int64).ravel()
    keys, twins = tail * vertex_count + head, head * vertex_count + tail
    order = np.argsort(keys)
    match = order[np.minimum(np.searchsorted(keys, twins, sorter=order), len(keys) - 1)]
    return np.where(keys[match] == twins, match // 3, -1).astype(np.int32).reshape(faces.shape)


def as_surface(mesh: MeshLike) -> Surface:
    """Convert a mesh in any of the accepted forms to a surface, and make sure that it can be mapped.

    A :class:`Surface` is returned itself, and is examined the first time only.

    Args:
        mesh: a ``trimesh.Trimesh``, ``(vertices, faces)``, a :class:`Surface`, or anything else that has ``vertices``
            and ``faces``.

    Raises:
        OmtwarpError: the value is no mesh, or the mesh cannot be mapped.
    """
    if isinstance(mesh, Surface):
        if not mesh.checked:
            require_valid(mesh.vertices, mesh.faces)
            mesh.checked = True
        return mesh
    surface = Surface(*require_valid(*mesh_arrays(mesh)))
    surface.checked = True
    return surface


def as_triangles(mesh: MeshLike) -> tuple[Floats, Ints]:
    """Return the vertices and faces of a mesh in any of the accepted forms, whether it can be mapped or not.

    Args:
        mesh: as of :func:`as_surface`.

    Returns:
        Finite vertices, float64, shape [V, 3], and faces among them, int32, shape [F, 3].

    Raises:
        OmtwarpError: the value is no mesh.
    """
    vertices, faces = mesh_arrays(mesh)
    positions = real_numbers(vertices, "vertices", (None, 3))
    return positions, as_faces(faces, len(positions))


def as_sphere(sphere: ArrayLike | wp.array, surface: Surface, name: str = "map") -> Floats | wp.array:
    """Check that the images of a surface's vertices lie on the unit sphere, and normalise them to round-off.

    Args:
        sphere: shape [V, 3]; a Warp array of vec3d, which only stages of the package make, is taken as it is.
        surface: the surface, V vertices.
        name: what to call the map in a message.

    Returns:
        float64, shape [V, 3]: the array given where it holds unit vectors to round-off, normalised otherwise.

    Raises:
        OmtwarpError: another shape, coordinates that are not finite, or points off the unit sphere.
    """
    if isinstance(sphere, wp.array):
        if sphere.shape != (surface.vertex_count,):
            raise OmtwarpError(f"the {name} has {sphere.shape} points: the surface has {surface.vertex_count} vertices")
        return sphere
    return as_unit_vectors(sphere, surface.vertex_count, name)


def as_unit_vectors(points: ArrayLike, count: int | None = None, name: str = "map") -> Floats:
    """Check that points lie on the unit sphere, and normalise them to round-off.

    Args:
        points: shape [N, 3].
        count: how many there must be; any number where left out.
        name: what to call them in a message.

    Returns:
        float64, shape [N, 3]: the array given where it holds unit vectors to round-off, normalised otherwise.

    Raises:
        OmtwarpError: another shape or type, coordinates that are not finite, or points off the unit sphere.
    """
    given = real_numbers(points, f"the {name}", (count, 3))
    arrays.require_unit_length(given, f"the {name}")
    lengths = norms(given)
    if np.abs(lengths - 1.0).max(initial=0.0) > ROUND_OFF:
        given = given / lengths[:, None]
    return given


def as_faces(faces: ArrayLike, count: int) -> Ints:
    """Check triangles whose corners are among a number of vertices.

    Args:
        faces: shape [F, 3], at least one.
        count: how many vertices there are.

    Raises:
        OmtwarpError: the faces are empty or of another shape or type, or a corner is out of range.
    """
    corners = whole_numbers(faces, "faces", (None, 3), below=count)
    if len(corners) == 0:
        raise OmtwarpError("faces: there are none")
    return corners.astype(np.int32)
