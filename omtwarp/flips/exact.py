"""Exact decisions about maps to the sphere: the orientation of triangles, and how often rings turn around vertices.

Orientation is decided by floating point where its rounding cannot have changed the sign, and by integers elsewhere.

A continuous map of a closed surface to the sphere whose triangles are all positive is a covering everywhere but at
vertices. Where the ring of neighbours goes k > 1 times around the image of a vertex, k sheets meet. On a connected
surface of genus 0 the number of sheets is 1 + sum(k - 1) / 2 (Riemann and Hurwitz), so that the map is one to one
exactly where every ring turns once. A count of flipped triangles alone does not see such vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.policy import HEAVY_LAUNCH, resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.device.threads import Each, computed, load, parts_of, run_all
from omtwarp.mesh.arrays import Floats, Ints, real_numbers, whole_number, whole_numbers

wp.set_module_options(KERNEL_OPTIONS)

UNCERTAIN = wp.constant(2)  # instead of a sign


@wp.kernel
def certain_signs(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    relative: wp.float64,
    underflow: wp.float64,
    # Data out:
    signs: wp.array[wp.int8],
):
    """Compute the signs of det[a, b, c] that rounding cannot have changed, and UNCERTAIN for the others."""
    f = wp.tid()
    a, b, c = points[faces[f][0]], points[faces[f][1]], points[faces[f][2]]
    value = wp.dot(a, wp.cross(b, c))
    magnitude = wp.abs(a[0]) * (wp.abs(b[1] * c[2]) + wp.abs(b[2] * c[1]))
    magnitude += wp.abs(a[1]) * (wp.abs(b[2] * c[0]) + wp.abs(b[0] * c[2]))
    magnitude += wp.abs(a[2]) * (wp.abs(b[0] * c[1]) + wp.abs(b[1] * c[0]))
    signs[f] = wp.int8(UNCERTAIN)
    if wp.isfinite(value) and wp.abs(value) > relative * magnitude + underflow:
        signs[f] = wp.where(value > ZERO, wp.int8(1), wp.int8(-1))


def _sent(sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, where: wp.Device) -> tuple[wp.array, wp.array]:
    """Return points and triangles on a device; NumPy's are checked, since kernels would read what is out of range."""
    points = sphere if isinstance(sphere, wp.array) else real_numbers(sphere, "sphere", (None, 3), finite=False)
    corners = faces if isinstance(faces, wp.array) else whole_numbers(faces, "faces", (None, 3), below=len(points))
    return vectors(points, where), triangles(corners, where)


def orientation_signs(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> NDArray[np.int8]:
    """Return the exact sign of det[a, b, c] for every triangle.

    The coordinates are taken as they are, so the points need not have unit length.

    Args:
        sphere: float64 points, shape [V, 3]; or a Warp array of vec3d.
        faces: Integer corner indices, shape [F, 3]; or a Warp array of vec3i.
        device: where floating point is tried.

    Returns:
        int8, shape [F]: 1 counter-clockwise seen from outside, -1 flipped, 0 exactly degenerate (the plane of the three
        points contains the origin) or a corner that is not finite.
    """
    where = resolve_device(device)
    given, corners = _sent(sphere, faces, where)
    out = wp.empty(len(corners), dtype=wp.int8, device=where)
    # Six triple products, each rounded at most four times, and their sum: 7 units of roundoff suffice, 8 also cover the
    # rounding of the bound. Fused multiply-add only lowers the error.
    # Products below the second number may have lost bits to gradual underflow, which a relative bound does not see.
    inputs = [given, Each(corners), wp.float64(8.0 * 2.0**-53), wp.float64(2.0**-1000)]
    signs = computed(certain_signs, inputs, out).numpy()
    open_cases = np.flatnonzero(signs == UNCERTAIN)
    if len(open_cases):
        signs[open_cases] = 0
        points, places = given.numpy(), corners.numpy()[open_cases]
        a, b, c = (points[places[:, k]] for k in range(3))
        usable = np.isfinite(np.hstack([a, b, c])).all(axis=1)
        signs[open_cases[usable]] = exact_signs(a[usable], b[usable], c[usable])
    return signs


def flipped_faces(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> NDArray[np.bool_]:
    """Find triangles with det[a, b, c] <= 0, decided exactly, or with a corner that is not finite; bool, shape [F]."""
    return orientation_signs(sphere, faces, device=device) <= 0


def count_flips(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> int:
    """Return the number of triangles with det[a, b, c] <= 0, decided exactly.

    A triangle with a corner that is not finite counts.
    """
    return int(flipped_faces(sphere, faces, device=device).sum())


def exact_signs(a: Floats, b: Floats, c: Floats) -> NDArray[np.int8]:
    """Return the signs of the determinants of finite points, shape [n, 3] each, in integer arithmetic."""
    if len(a) == 0:
        return np.zeros(0, dtype=np.int8)
    ia, ib, ic = (_common_integers(x) for x in (a, b, c))
    value = (
        ia[:, 0] * (ib[:, 1] * ic[:, 2] - ib[:, 2] * ic[:, 1])
        + ia[:, 1] * (ib[:, 2] * ic[:, 0] - ib[:, 0] * ic[:, 2])
        + ia[:, 2] * (ib[:, 0] * ic[:, 1] - ib[:, 1] * ic[:, 0])
    )
    return (value > 0).astype(np.int8) - (value < 0).astype(np.int8)


def _common_integers(points: Floats) -> NDArray[np.object_]:
    """Scale every point by its own power of two to integer coordinates, as Python integers."""
    mantissa, exponent = np.frexp(points)
    exponent = np.where(points == 0.0, exponent.max(initial=0), exponent)
    shift = exponent - exponent.min(axis=1, keepdims=True)
    integers = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    return integers << shift.astype(object)


SCALE = wp.constant(wp.float64(2.0**40))  # steps of a radian: sums of 10^6 angles fit int64, and a step is 1e-12


@wp.kernel
def add_turning_angles(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    signs: wp.array[wp.int8],
    direction_error: wp.float64,
    angle_error: wp.float64,
    # Data out:
    angles: wp.array[wp.int64],
    errors: wp.array[wp.int64],
):
    """Add every triangle's signed angle to each of its corners, with a bound on its rounding error.

    The direction from p towards a is that of the normal p x (a - p) of the great circle through both. Angles are added
    as whole multiples of 1 / SCALE radians, whose sum does not depend on the order.
    """
    f, _compiled_once = wp.tid()
    face = faces[f]
    for k in range(3):
        p = points[face[k]]
        towards_a = points[face[(k + 1) % 3]] - p
        towards_b = points[face[(k + 2) % 3]] - p
        a = wp.cross(p, towards_a)
        b = wp.cross(p, towards_b)
        length_a, length_b = wp.length(a), wp.length(b)
        error = direction_error * wp.length(p) * (wp.length(towards_a) / length_a + wp.length(towards_b) / length_b)
        angle = wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))
        if signs[f] < wp.int8(0):
            angle = -angle
        elif signs[f] == wp.int8(0):
            angle = ZERO
        error += angle_error + ONE / SCALE
        if not error < ONE:  # also where a length is 0
            error = ONE
            angle = ZERO
        wp.atomic_add(angles, face[k], wp.int64(wp.rint(SCALE * angle)))
        wp.atomic_add(errors, face[k], wp.int64(wp.ceil(SCALE * error)))


UNIT_ROUNDOFF = 2.0**-53  # of float64, rounding to nearest
# The difference of two points and their cross product are rounded four times in each of three components.
_DIRECTION_ERROR = 16.0 * UNIT_ROUNDOFF
# The angle between two given directions: products, lengths, arc tangent and sum.
_ANGLE_ERROR = 32.0 * UNIT_ROUNDOFF
# Sums of angles are multiples of 2π up to their rounding: with less than this, in radians, only one is near.
_CERTAIN = 1.0


def ring_turns(
    sphere: ArrayLike | wp.array,
    faces: ArrayLike | wp.array,
    *,
    signs: NDArray[np.int8] | None = None,
    device: str | wp.Device | None = "cpu",
) -> Ints:
    """Return how often the ring of every vertex goes around it on the sphere, decided exactly.

    Args:
        sphere: float64 points, shape [V, 3], of any length but 0; or a Warp array of vec3d.
        faces: integer corner indices, shape [F, 3]; or a Warp array of vec3i.
        signs: what :func:`omtwarp.flips.exact.orientation_signs` says of the triangles, int8, shape [F]; computed
            here when left out.
        device: where floating point is tried.

    Returns:
        int32, shape [V]: 1 where the ring turns once counter-clockwise, as it does in a bijection; 0 for a vertex
        without triangles. Next to a triangle of sign 0 the number has no meaning.

    Example:
        >>> from omtwarp.mesh.shapes import icosphere
        >>> surface = icosphere(2)
        >>> set(ring_turns(surface.vertices, surface.faces).tolist())
        {1}
    """
    where = resolve_device(device)
    points, corners = _sent(sphere, faces, where)
    whole_number(len(corners), "the number of faces", least=1)
    if signs is None:
        signs = orientation_signs(points, corners, device=where)
    sent = wp.array(np.ascontiguousarray(signs, dtype=np.int8), dtype=wp.int8, device=where, copy=False)
    bounds = [wp.float64(_DIRECTION_ERROR), wp.float64(_ANGLE_ERROR)]

    def added(part: slice) -> NDArray[np.int64]:
        sums = wp.zeros((2, len(points)), dtype=wp.int64, device=where)
        inputs, count = [points, corners[part], sent[part], *bounds], part.stop - part.start
        wp.launch(add_turning_angles, dim=count, inputs=inputs, outputs=[sums[0], sums[1]], device=where)
        return sums.numpy()

    load(add_turning_angles, where)
    angles, errors = np.sum(run_all(added, parts_of(len(corners), where, HEAVY_LAUNCH)), axis=0)
    total, error = angles / (2.0 * np.pi * float(SCALE)), errors / float(SCALE)
    certain = error < _CERTAIN
    turns: Ints = np.rint(np.where(certain, total, 0.0)).astype(np.int32)
    if not certain.all():
        _turn_exactly(points.numpy(), corners.numpy(), signs, ~certain, turns)
    return turns


@dataclass(frozen=True)
class Examined:
    """Orientations and turns that decide whether a map is one to one.

    Attributes:
        sphere: as given to :func:`examine`.
        faces: likewise.
        device: likewise.
        signs: of the triangles, as of :func:`omtwarp.flips.exact.orientation_signs`, int8, shape [F].
        turns: of the rings around vertices, as of :func:`ring_turns`, int32, shape [V]; computed when first read.
    """

    sphere: ArrayLike | wp.array
    faces: ArrayLike | wp.array
    device: str | wp.Device | None
    signs: NDArray[np.int8]

    @cached_property
    def turns(self) -> Ints:
        return ring_turns(self.sphere, self.faces, signs=self.signs, device=self.device)

    @property
    def tangled(self) -> NDArray[np.bool_]:
        """The triangles that keep the map from being one to one, as of :func:`tangled_faces`, bool, shape [F]."""
        faces = self.faces.numpy() if isinstance(self.faces, wp.array) else np.asarray(self.faces, int).reshape(-1, 3)
        tangled: NDArray[np.bool_] = self.signs <= 0
        wound = self.turns != 1
        if wound.any():
            wound[faces[tangled]] = False
            tangled |= wound[faces].any(axis=1)
        return tangled

    @property
    def flips(self) -> int:
        """Number of triangles that are flipped or degenerate."""
        return int((self.signs <= 0).sum())

    @property
    def bijective(self) -> bool:
        """Whether the map is one to one and onto, for a closed connected surface of genus 0 without loose vertices."""
        return bool((self.signs > 0).all() and (self.turns == 1).all())


def examine(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> Examined:
    """Decide the orientation of all triangles and the turns of all rings; arguments as of :func:`tangled_faces`."""
    return Examined(sphere, faces, device, orientation_signs(sphere, faces, device=device))


def tangled_faces(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> NDArray[np.bool_]:
    """Return the triangles that keep a map from being one to one.

    They are flipped, or lie around a vertex without a flipped triangle whose ring turns more than once.

    Args:
        sphere: float64 points, shape [V, 3]; or a Warp array of vec3d.
        faces: integer corner indices, shape [F, 3]; or a Warp array of vec3i.
        device: where floating point is tried.

    Returns:
        bool, shape [F]. None is True exactly where the map of a closed connected surface of genus 0 is a bijection.
    """
    return examine(sphere, faces, device=device).tangled


def is_bijective(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> bool:
    """Decide exactly whether a map of a closed connected surface of genus 0 to the sphere is one to one and onto.

    Every triangle is positive and every ring turns once: the module's docstring says why that suffices.

    Args:
        sphere: float64 points, shape [V, 3]; or a Warp array of vec3d.
        faces: integer corner indices, shape [F, 3]; or a Warp array of vec3i.
        device: where floating point is tried.

    Example:
        >>> from omtwarp.mesh.shapes import icosphere
        >>> surface = icosphere(2)
        >>> is_bijective(surface.vertices, surface.faces), is_bijective(-surface.vertices, surface.faces)
        (True, False)
    """
    return not tangled_faces(sphere, faces, device=device).any()


def _turn_exactly(points: Floats, faces: Ints, signs: NDArray[np.int8], asked: NDArray[np.bool_], turns: Ints) -> None:
    """Fill in the turns of the vertices asked for, by counting how often their rings cross one of their spokes.

    A triangle's side crosses the spoke towards r where its ends lie on both sides of the great circle through the
    vertex and r, and the triangle's own orientation says on which side of the vertex it passes.
    """
    face, corner = np.nonzero(asked[faces])
    centre, a, b = (faces[face, (corner + k) % 3] for k in range(3))
    spoke = np.zeros(len(points), dtype=np.int32)
    spoke[centre] = a
    usable = np.isfinite(points[np.stack([centre, a, b, spoke[centre]])]).all(axis=(0, 2))
    face, centre, a, b = face[usable], centre[usable], a[usable], b[usable]
    p, r = points[centre], points[spoke[centre]]
    left_a, left_b = (exact_signs(p, r, points[end]) >= 0 for end in (a, b))
    crossing = (~left_a & left_b & (signs[face] > 0)).astype(np.int32)
    crossing -= (left_a & ~left_b & (signs[face] < 0)).astype(np.int32)
    turns[asked] = 0
    np.add.at(turns, centre, crossing)
