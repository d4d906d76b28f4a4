"""Built-in patterns: functions of direction on the sphere, exact at every resolution and without a seam or a pole.

Those of section 5 of the paper, one a file. A pattern is called with directions and gives colours::

    pattern("circles", count=162)(directions)  # [N, 3] -> [N, 3], red, green and blue in 0..1

With its colour every direction gets its reach: an angle in radians within which the colour changes gradually, without
an edge. It is never too large; beyond some angle, which is small beside a pattern's cells, edges are not looked for.

A new pattern is a file here with a class, and its name in :class:`omtwarp.options.PatternName`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from importlib import import_module
from typing import TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import sent
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import HALF, KERNEL_OPTIONS, wp
from omtwarp.device.threads import Each, each, launch_parts
from omtwarp.errors import OmtwarpError, check_word
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.options import PatternLike, PatternName

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def longitude(d: wp.vec3d):
    return wp.atan2(d[1], d[0])


@wp.func
def latitude(d: wp.vec3d):
    return wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))


@wp.func
def cell_of(value: wp.float64, low: wp.float64, high: wp.float64, count: int):
    """Return which of ``count`` equal cells between two numbers a value falls in, the last one closed."""
    k = int(wp.floor((value - low) / (high - low) * wp.float64(count)))
    return wp.clamp(k, 0, count - 1)


@wp.func
def near_multiple(value: wp.float64, step: wp.float64):
    """Return the distance to the nearest multiple of a step."""
    return wp.abs(value - step * wp.floor(value / step + HALF))


def srgb_colours(*names: str) -> Floats:
    """Return colours like ``#1f6f78`` as numbers from 0 to 1, shape [N, 3]."""
    return np.array([[int(name[k : k + 2], 16) for k in (1, 3, 5)] for name in names]) / 255.0


class ValueSource(ABC):
    """Values of directions of any length, on a device."""

    channels: int

    @abstractmethod
    def launch(self, directions: wp.array, out: wp.array) -> object:
        """Write the values of directions, vec3d [N], to an array, float64 [N, channels]."""

    def at(self, directions: ArrayLike, where: wp.Device) -> Floats:
        """Return the values of directions of any length, shape [N, 3], as float64, shape [N, channels]."""
        d = np.ascontiguousarray(np.asarray(directions, dtype=np.float64).reshape(-1, 3))
        out = wp.empty((len(d), self.channels), dtype=wp.float64, device=where)
        if len(d):
            self.launch(wp.array(d, dtype=wp.vec3d, device=where), out)
        return out.numpy()


class Pattern(ValueSource):
    """A colour for every direction on the sphere.

    Attributes:
        name: as in :class:`omtwarp.options.PatternName`; its class is that name with a capital letter.
        title: what a page calls it.
    """

    name: str
    title = "The pattern"
    channels = 3

    def __call__(self, directions: ArrayLike, device: str | wp.Device = "cpu") -> Floats:
        """Return the colours of directions of any length, shape [N, 3], as float64 from 0 to 1, shape [N, 3]."""
        return self.at(directions, resolve_device(device))

    def launch(self, directions: wp.array, out: wp.array) -> wp.array:
        """Colour an array of directions (vec3d, shape [N]) into ``out`` (float64, shape [>= N, 3]) on their device.

        Returns:
            The reach of every direction, float64, shape [N]: an angle in radians within which there is no edge.
        """
        device = directions.device
        reach = wp.empty(len(directions), dtype=wp.float64, device=device)
        launch_parts(self._kernel, len(directions), [Each(directions), *self._inputs(device)], each(out, reach), device)
        return reach

    _kernel: wp.Kernel

    def _inputs(self, device: wp.Device) -> list[object]:
        if not hasattr(self, "_uploaded"):
            self._uploaded: dict[str, list[object]] = {}
        if device.alias not in self._uploaded:
            tables = self._tables()
            self._uploaded[device.alias] = [sent(x[0], x[1], device) if isinstance(x, tuple) else x for x in tables]
        return self._uploaded[device.alias]

    @abstractmethod
    def _tables(self) -> list[object]:
        """Return the kernel's inputs that stand between the directions and the output.

        A pair (array, Warp dtype) is uploaded once per device.
        """


def colour_groups(neighbours: NDArray, colours: int) -> Ints:
    """Colour every cell unlike its neighbours, using colours as evenly as that allows, shape [N].

    Cells are coloured in smallest-last order (Matula and Beck, J. ACM 30, 1983): in a planar graph every cell meets
    at most five coloured neighbours then, so that six colours always suffice.

    Args:
        neighbours: pairs of neighbouring cells, shape [E, 2].
        colours: how many there are.
    """
    count = int(neighbours.max()) + 1
    around: list[set[int]] = [set() for _ in range(count)]
    for one, other in neighbours.tolist():  # a few hundred cells of a pattern, not elements of a mesh
        around[one].add(other)
        around[other].add(one)
    degree = np.array([len(x) for x in around])
    order = []
    for _ in range(count):
        cell = int(np.argmin(degree))
        order.append(cell)
        degree[list(around[cell])] -= 1
        degree[cell] = 2 * count  # taken: it stays above all others
    group = np.full(count, -1, dtype=np.int32)
    used = np.zeros(colours, dtype=np.int64)
    for cell in reversed(order):
        taken = np.zeros(colours, dtype=bool)
        taken[[group[other] for other in around[cell] if group[other] >= 0]] = True
        group[cell] = np.lexsort((used, taken))[0]
        used[group[cell]] += 1
    return group


@lru_cache(maxsize=16)
def _made(name: str, **options: int | str) -> Pattern:
    """Return a pattern of the class that its file is named after."""
    kind: type[Pattern] = getattr(import_module(f"{__name__}.{name}"), name.capitalize())
    return kind(**options)


def is_name(given: object) -> TypeGuard[PatternLike]:
    """Return whether a text is the name of a pattern."""
    return isinstance(given, str) and given in tuple(PatternName)


def pattern(name: str | Pattern, **options: int | str) -> Pattern:
    """Return a built-in pattern by name, with the options of its class.

    Raises:
        OmtwarpError: a name that does not exist, or an option that the pattern does not have.
    """
    if isinstance(name, Pattern):
        return name
    check_word("pattern", name, PatternName)
    try:
        return _made(name, **options)
    except TypeError as error:
        raise OmtwarpError(f"pattern {name}: {error}") from error


__all__ = ["is_name", "pattern"]
