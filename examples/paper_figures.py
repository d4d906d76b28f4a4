"""Make the paper's figures again: 3, 5, 6, 8, 9, 10 to 13 and 14, as PNG.

    python examples/paper_figures.py MESH [MESH ...] --out out/figures
    python examples/paper_figures.py --figures 3 8 9              # these need no mesh
    python examples/paper_figures.py                              # with a small made shape

Each figure takes the mesh whose file name begins with the model the paper shows (Max Planck for 5, 6 and 11, the
squirrel for 10 and 14, the bucket for 12, the bunny for 13), or else the first one given.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import omtwarp
from omtwarp.render import Arrows, Camera, ScalarField, SurfaceView, preview, sheet

FIGURES = (3, 5, 6, 8, 9, 10, 11, 12, 13, 14)
MODELS = {5: "maxplanck", 6: "maxplanck", 10: "squirrel", 11: "maxplanck", 12: "bucket", 13: "bunny", 14: "squirrel"}
# Which way is up and where the camera stands (azimuth, elevation in degrees), where the default does not suit.
LOOKS: dict[str, tuple[str, tuple[float, float]]] = {"maxplanck": ("y", (150.0, 22.0))}
TEXTURES = {10: "circles", 11: "puzzle"}
PANEL = (640, 640)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path, help="mesh files; none: a small made shape")
    parser.add_argument("--out", type=Path, default=Path("out/figures"), help="folder for the pictures")
    parser.add_argument("--figures", type=int, nargs="+", default=list(FIGURES), choices=FIGURES, metavar="N")
    parser.add_argument("--refine", default="none", help="refine the map too: area, balanced, angle or a number")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    meshes = Meshes(options)
    for number in options.figures:
        path = options.out / f"figure_{number:02d}.png"
        DRAW[number](path, meshes, number)
        print(path, flush=True)


class Meshes:
    """The meshes given and their maps, each made once."""

    def __init__(self, options: argparse.Namespace):
        self.options = options
        self.paths: dict[str, Path] = {path.name.split(".")[0]: path for path in options.meshes}
        self.maps: dict[str, omtwarp.MapResult] = {}

    def name_for(self, number: int) -> str:
        if not self.paths:
            return "demo"
        wanted = MODELS[number]
        return next((n for n in self.paths if n.lower().replace("-", "").startswith(wanted)), next(iter(self.paths)))

    def surface(self, name: str) -> omtwarp.Surface:
        if name == "demo":
            return omtwarp.shapes.demo_shape(4000)
        mesh = omtwarp.read_mesh(self.paths[name])
        return omtwarp.Surface(mesh.vertices, mesh.faces)

    def map(self, name: str) -> omtwarp.MapResult:
        if name not in self.maps:
            refine = self.options.refine
            until = "omt" if refine == "none" else "refine"
            self.maps[name] = omtwarp.map_to_sphere(
                self.surface(name), until=until, refine=refine, device=self.options.device
            )
        return self.maps[name]


def look(name: str) -> tuple[str, Camera]:
    """The upward axis and the camera of a model."""
    plain = name.lower().replace("-", "")
    up, (azimuth, elevation) = next(
        (value for model, value in LOOKS.items() if plain.startswith(model)), ("y", (-30.0, 15.0))
    )
    return up, Camera(azimuth=azimuth, elevation=elevation)


def textured(result: omtwarp.MapResult, sphere: np.ndarray, image: np.ndarray, name: str, caption: str) -> SurfaceView:
    return SurfaceView(result.vertices, result.faces, image=image, sphere=sphere, up=look(name)[0], caption=caption)


def draw_sheet(panels: list[Any], path: Path, camera: Camera | None = None, **more: Any) -> None:
    sheet(panels, path, size=PANEL, columns=len(panels) if len(panels) < 4 else 2, camera=camera, **more)


# --- Figures without a mesh -----------------------------------------------------------------------------------------


def wavelets(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 3: a scaling function and wavelets, hat and butterfly, as heights over the sphere."""
    from omtwarp.wavelets import SphericalWavelets, sphere_hierarchy

    hierarchy = sphere_hierarchy(7)
    points = hierarchy.vertices
    direction = np.array([0.9, -0.25, 0.35])

    def nearest(first: int, last: int) -> int:
        return first + int(np.argmax(points[first:last] @ direction))

    counts = hierarchy.node_counts
    hat = SphericalWavelets(hierarchy, device=meshes.options.device)
    butterfly = SphericalWavelets(hierarchy, butterfly=True, device=meshes.options.device)
    drawn = [
        ("scaling function, hat, level 2", hat.scaling_function(2, nearest(0, counts[2]))),
        ("wavelet, hat, level 2", hat.wavelet(nearest(counts[2], counts[3]))),
        ("scaling function, butterfly, level 2", butterfly.scaling_function(2, nearest(0, counts[2]))),
        ("wavelet, butterfly, level 2", butterfly.wavelet(nearest(counts[2], counts[3]))),
    ]
    panels = []
    for caption, values in drawn:
        size = float(np.abs(values).max())
        shape = points * (1.0 + 0.35 * values / size)[:, None]
        scalar = ScalarField(values / size, colormap="coolwarm", range=(-1.0, 1.0))
        panels.append(SurfaceView(shape, hierarchy.faces, scalar=scalar, up="z", front="+x", caption=caption))
    draw_sheet(panels, path, Camera(azimuth=-35.0, elevation=2.0), color_bar=False)


def longitude_lines(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 8: the lines of longitude in a flat picture, before and after the correction by cos(latitude)."""
    pyplot = plotting()
    from omtwarp.mesh.arrays import direction_from_angles
    from omtwarp.texturing import direction_to_image

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 3.2), layout="constrained")
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 361)
    for axis, projection in zip(axes, ("equirectangular", "sinusoidal"), strict=True):
        for degrees in range(-175, 181, 10):
            directions = direction_from_angles(np.full_like(latitude, np.deg2rad(degrees)), latitude)
            uv = direction_to_image(directions, projection)
            axis.plot(360 * uv[:, 0] - 180, 180 * uv[:, 1] - 90, color="#2f5d73", linewidth=0.8)
        axis.set(xlim=(-180, 180), ylim=(-90, 90), aspect="equal", title=f"{projection} picture")
        axis.set_xlabel("picture, horizontal [degrees]")
        axis.set_ylabel("latitude [degrees]")
    figure.savefig(path, dpi=160)
    pyplot.close(figure)


def flat_picture(width: int = 2048) -> np.ndarray:
    """Equal coloured discs in rows, a picture that was not made for the sphere, uint8 [width / 2, width, 3]."""
    height, cells = width // 2, 24
    cell = width / cells
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    column, row = (x // cell).astype(int), (y // cell).astype(int)
    radius = np.hypot(x - (column + 0.5) * cell, y - (row + 0.5) * cell) / cell
    palette = np.array([[196, 61, 61], [47, 93, 115], [214, 160, 55], [84, 130, 84]], dtype=np.uint8)
    picture = np.full((height, width, 3), (246, 241, 230), dtype=np.uint8)
    inside = radius < 0.38
    picture[inside] = palette[(column + 2 * row) % 4][inside]
    return picture


def warped_sphere(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 9: a flat picture on the sphere as it is, and with the longitude corrected."""
    from omtwarp.texturing import bake
    from omtwarp.texturing.image import as_bytes

    globe = omtwarp.shapes.icosphere(48)
    points = globe.vertices / np.linalg.norm(globe.vertices, axis=1)[:, None]
    picture = flat_picture()
    warped = as_bytes(
        bake(picture, "equirectangular", projection="sinusoidal", size=(2048, 1024), device=meshes.options.device)
    )
    panels = [
        SurfaceView(points, globe.faces, image=image, sphere=points, up="z", front="+x", caption=caption)
        for image, caption in ((picture, "as it is"), (warped, "longitude scaled by cos(latitude)"))
    ]
    draw_sheet(panels, path, Camera(azimuth=20.0, elevation=35.0))


# --- Curvature and area ---------------------------------------------------------------------------------------------


def mean_curvature(surface: omtwarp.Surface) -> np.ndarray:
    """Mean curvature at the vertices, positive where convex, from the cotangent Laplacian of the positions, [V]."""
    from omtwarp.geometry import cotangent_laplacian

    points = surface.scaled_vertices
    vector = cotangent_laplacian(points, surface.faces) @ points  # 2 H n times the vertex' area
    p0, p1, p2 = (points[surface.faces[:, k]] for k in range(3))
    normal = np.cross(p1 - p0, p2 - p0)
    normal = np.stack([surface.sum_to_vertices(normal[:, d]) for d in range(3)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    return (vector * normal).sum(axis=1) / (2.0 * surface.vertex_areas)


def curvature_field(surface: omtwarp.Surface) -> ScalarField:
    """Red where convex, blue where concave; the extreme tenth saturates."""
    values = mean_curvature(surface)
    limit = float(np.percentile(np.abs(values), 90))
    return ScalarField(values, colormap="coolwarm", range=(-limit, limit), label="mean curvature")


def ratio_histogram(result: omtwarp.MapResult, sphere: np.ndarray, title: str) -> Any:
    """Area of every triangle on the sphere over its area on the surface, as a picture."""
    from PIL import Image

    pyplot = plotting()
    ratio = omtwarp_distortion(result, sphere).area_ratio
    weights = omtwarp.Surface(result.vertices, result.faces).face_areas
    bins = np.linspace(-3.0, 3.0, 121)
    figure, axis = pyplot.subplots(figsize=(4, 4), dpi=160, layout="constrained")
    decades = np.log10(np.maximum(ratio, 1e-300))
    axis.hist(np.clip(decades, bins[0], bins[-1]), bins=bins, weights=weights / weights.sum(), color="#2f5d73")
    axis.set(xlabel="log10 of area on the sphere / area on the surface", ylabel="part of the surface", title=title)
    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])  # type: ignore[attr-defined]
    pyplot.close(figure)
    return picture


def omtwarp_distortion(result: omtwarp.MapResult, sphere: np.ndarray) -> Any:
    from omtwarp.metrics import distortion

    return distortion(result, sphere)


def sphere_view(result: omtwarp.MapResult, sphere: np.ndarray, caption: str, **more: Any) -> SurfaceView:
    return SurfaceView(sphere, result.faces, up="z", front="+x", caption=caption, **more)


def facing(direction: np.ndarray, zoom: float = 1.0) -> Camera:
    """A camera that looks at a point of a sphere drawn with z up and +x in front."""
    x, y, z = direction / np.linalg.norm(direction)
    azimuth = float(np.rad2deg(np.arctan2(y, x)))
    return Camera(azimuth=azimuth, elevation=float(np.rad2deg(np.arcsin(z))), zoom=zoom)


def crowded(result: omtwarp.MapResult) -> int:
    """The vertex of a sharp feature that the conformal map shrinks most: density times convexity, evened out, peaks."""
    from scipy import sparse

    surface = omtwarp.Surface(result.vertices, result.faces)
    score = result.density * np.clip(mean_curvature(surface), 0.0, None)
    score = np.minimum(score, np.percentile(score, 99.0))
    i, j = surface.edges.T
    ones = np.ones(len(i))
    adjacent = sparse.csr_matrix((ones, (i, j)), shape=(surface.vertex_count,) * 2)
    adjacent = adjacent + adjacent.T
    count = np.asarray(adjacent.sum(axis=1)).ravel()
    for _ in range(20):
        score = 0.5 * score + 0.5 * (adjacent @ score) / count
    return int(np.argmax(score))


def curvature_before(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 5: curvature on the surface and on its conformal image, and the histogram of area ratios."""
    name = meshes.name_for(number)
    result = meshes.map(name)
    field = curvature_field(omtwarp.Surface(result.vertices, result.faces))
    up, camera = look(name)
    shown = SurfaceView(result.vertices, result.faces, scalar=field, up=up)
    panels = [
        preview(shown, size=PANEL, camera=camera, color_bar=False),
        preview(
            sphere_view(result, result.conformal, "", scalar=field),
            size=PANEL,
            camera=facing(result.conformal[crowded(result)]),
            color_bar=False,
        ),
        ratio_histogram(result, result.conformal, "area ratio, conformal").resize(PANEL),
    ]
    draw_sheet(panels, path, captions=["surface", "conformal image", "area ratios"])


def curvature_after(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 6: curvature on the optimal image, its area ratios, and the field that moves the vertices at a detail."""
    result = meshes.map(meshes.name_for(number))
    field = curvature_field(omtwarp.Surface(result.vertices, result.faces))
    feature = crowded(result)
    start, end = result.conformal, result.sphere
    moved = end - (start * end).sum(axis=1)[:, None] * start
    arrows = Arrows(moved, count=4000, color="#1f4fd0", length=0.08)
    detail = sphere_view(result, start, "", scalar=field, arrows=arrows)
    panels = [
        preview(sphere_view(result, end, "", scalar=field), size=PANEL, camera=facing(end[feature]), color_bar=False),
        ratio_histogram(result, end, "area ratio, optimal").resize(PANEL),
        preview(detail, size=PANEL, camera=facing(start[feature], zoom=4.0), color_bar=False),
    ]
    draw_sheet(panels, path, captions=["optimal image", "area ratios", "displacement on the conformal image"])


# --- Textures -------------------------------------------------------------------------------------------------------


def conformal_and_optimal(path: Path, meshes: Meshes, number: int) -> None:
    """Figures 10 and 11: a pattern through the conformal and through the optimal map."""
    from omtwarp.texturing import rasterize

    name = meshes.name_for(number)
    result = meshes.map(name)
    image = rasterize(TEXTURES[number], 4096, device=meshes.options.device)
    panels = [
        textured(result, result.conformal, image, name, "conformal"),
        textured(result, result.sphere, image, name, "optimal mass transport"),
    ]
    draw_sheet(panels, path, look(name)[1])


def globe_on_bucket(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 12: the globe through both maps, from two sides."""
    from omtwarp.texturing import rasterize

    name = meshes.name_for(number)
    result = meshes.map(name)
    image = rasterize("globe", 4096, device=meshes.options.device)
    camera = look(name)[1]
    panels, captions = [], []
    for elevation, side in ((camera.elevation, "from the side"), (camera.elevation + 45.0, "from above")):
        for sphere, which in ((result.conformal, "conformal"), (result.sphere, "optimal")):
            view = textured(result, sphere, image, name, "")
            panels.append(preview(view, size=PANEL, camera=camera.looking(camera.azimuth, elevation)))
            captions.append(f"{which}, {side}")
    sheet(panels, path, size=PANEL, columns=2, captions=captions)


def four_methods(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 13: circles through mean-value, Tutte, conformal and optimal maps."""
    from omtwarp.baselines import barycentric_map
    from omtwarp.texturing import rasterize

    name = meshes.name_for(number)
    result = meshes.map(name)
    surface = omtwarp.Surface(result.vertices, result.faces)
    image = rasterize("circles", 4096, device=meshes.options.device)
    maps = [
        ("mean-value weights", barycentric_map(surface, weights="mean-value", device=meshes.options.device).sphere),
        ("Tutte weights", barycentric_map(surface, weights="tutte", device=meshes.options.device).sphere),
        ("conformal", result.conformal),
        ("optimal mass transport", result.sphere),
    ]
    panels = [textured(result, sphere, image, name, caption) for caption, sphere in maps]
    draw_sheet(panels, path, look(name)[1])


# --- Convergence ----------------------------------------------------------------------------------------------------


def cost_curve(path: Path, meshes: Meshes, number: int) -> None:
    """Figure 14: cost against iteration, for the paper's V-cycles, the plain flow and the default.

    On the left from Moser's map, as in the paper: it is within a per cent of the optimal cost, so that a little area
    lost on the way shows as cost below the bound. On the right from that map with its parallels turned, which keeps
    areas and costs far more.
    """
    import convergence

    from omtwarp.flips.exact import count_flips
    from omtwarp.metrics.optimality import optimality
    from omtwarp.transport.flow import MAXIMUM_ITERATIONS

    pyplot = plotting()
    name = meshes.name_for(number)
    result = meshes.map(name)
    surface = omtwarp.Surface(result.vertices, result.faces)
    device = meshes.options.device
    if result.transported is None:
        raise omtwarp.OmtwarpError("the map has no optimal map to compare the flow with")
    moser = omtwarp.untangle(surface, omtwarp.moser_map(surface, result.conformal, device=device).sphere).sphere
    report = optimality(surface, result.transported, start=result.conformal, device=device)
    # The report's bound is one for points with masses, the cost here that of whole triangles: they share the gap.
    bound = result.history[-1]["cost"] / (1.0 + report.gap)
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    # The strongest twist that does not flip triangles around the poles.
    twists = (convergence.twisted(moser, amount) for amount in (0.25, 0.12, 0.06, 0.03))
    turned = next((twist for twist in twists if not count_flips(twist, surface.faces)), moser)
    starts = (moser, "from Moser's map"), (turned, "from a twisted map")
    for side, (start, title) in zip(axes, starts, strict=True):
        for scheme, label in (("default", "default"), ("plain", "plain"), ("paper", "Algorithm 2")):
            most = MAXIMUM_ITERATIONS["plain"]
            flow = convergence.run(name, surface, result.conformal, start, title, scheme, most, device)
            values, color = flow["costs"], convergence.COLORS[scheme]
            side.plot(values, label=f"{label} ({len(values) - 1})", color=color)
        side.axhline(bound, color="0.3", linewidth=0.8, linestyle="--", label="lower bound")
        side.set(xlabel="iteration", ylabel="cost M, squared distance", title=f"{name}, {title}")
        side.legend()
    axes[1].set_xscale("symlog", linthresh=10)
    axes[1].set_xlim(left=0)
    figure.savefig(path, dpi=160)
    pyplot.close(figure)


def plotting() -> Any:
    """Matplotlib without a display."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


DRAW = {
    3: wavelets,
    5: curvature_before,
    6: curvature_after,
    8: longitude_lines,
    9: warped_sphere,
    10: conformal_and_optimal,
    11: conformal_and_optimal,
    12: globe_on_bucket,
    13: four_methods,
    14: cost_curve,
}

if __name__ == "__main__":
    try:
        main()
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
