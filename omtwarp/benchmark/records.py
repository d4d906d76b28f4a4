"""Results of a benchmark, as plain numbers ready for JSON."""

from __future__ import annotations

from typing import NotRequired, TypedDict


class StageTimes(TypedDict):
    """A stage of a map; times in seconds, ``ratio`` to the reference's."""

    name: str
    seconds: float
    cpu_seconds: float
    iterations: int
    flips: int
    area: float
    ratio: NotRequired[float | None]


class MapTimes(TypedDict):
    """A map, or the medians of several; memory in bytes above what the process held before.

    ``device_bytes`` is None where an earlier map of the process needed as much of the device.
    """

    device: NotRequired[str]
    seconds: float
    cpu_seconds: float
    ratio: NotRequired[float | None]
    cpu_ratio: NotRequired[float | None]
    peak_bytes: int | None
    device_bytes: int | None
    flips: int
    bijective: bool
    stages: list[StageTimes]


class MeshTimes(TypedDict):
    """A mesh, its reference where it was measured, and its maps, one on each device."""

    family: str
    name: str
    vertices: int
    faces: int
    splu: dict[str, float] | None
    factor_bytes: int
    runs: list[MapTimes]


class KernelRow(TypedDict):
    """All launches of a kernel: their number, time and the memory that they had to move."""

    name: str
    launches: int
    threads: int
    seconds: float
    bytes: int
    bytes_per_second: float
    part_of_copy: float


class FlowTimes(TypedDict):
    """The mean iteration of the transport flow, as :func:`omtwarp.benchmark.roofline.flow_iterations` has it."""

    iterations: int
    seconds: float
    launches: float
    bytes: float
    part_of_copy: NotRequired[float]


class KernelTable(TypedDict):
    """The kernels of a map on a device, and the rate of a plain copy in bytes per second."""

    device: str
    faces: int
    bandwidth: float
    kernels: list[KernelRow]
    flow: FlowTimes


class Gpu(TypedDict):
    """A CUDA device; memory in bytes."""

    name: str
    memory: int
    arch: int


class Machine(TypedDict):
    """The machine and the versions of the libraries; memory in bytes."""

    processor: str
    cores: int
    memory: int | None
    system: str
    gpus: list[Gpu]
    load_before: float | None
    blas_threads: str
    versions: dict[str, str]


class Settings(TypedDict):
    """The settings of a benchmark."""

    repeats: int
    refine: str | float | None
    largest_reference: int


class Benchmark(TypedDict):
    """A whole benchmark; exponents of growth by family, device and stage."""

    format: int
    machine: Machine
    settings: Settings
    meshes: list[MeshTimes]
    growth: NotRequired[dict[str, dict[str, dict[str, float]]]]
    kernels: NotRequired[list[KernelTable]]
    first_use: NotRequired[dict[str, dict[str, float]]]
