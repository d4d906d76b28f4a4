"""Pages and files about groups of shapes, and about registrations: tables, meshes, and pictures of what differs."""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import make_folder, write_table
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, Ints, dots
from omtwarp.mesh.data import VertexData, write_data
from omtwarp.mesh.neuro import structure_of
from omtwarp.mesh.surface import Surface, vertex_normals
from omtwarp.mesh.write import write_mesh
from omtwarp.registration.register import Registration
from omtwarp.registration.strain import strain_at_vertices
from omtwarp.render import film, preview
from omtwarp.render.scene import ScalarField
from omtwarp.reporting.markup import Markup, element, figure, pictures, table, write_plain_page
from omtwarp.resampling import SpherePoints, resample
from omtwarp.shape_analysis.group import GROUP, Effect, GroupStudy, mirrored_words, table_of

SHOWN = 2.0  # standard deviations to either side of the mean
SIGNIFICANT = 0.05  # level of the corrected p values, the customary one


def write_group_report(
    study: GroupStudy,
    folder: Path,
    names: Sequence[str],
    labels: Sequence[str] | None = None,
    covariates: Mapping[str, Sequence[object]] | None = None,
    like: Path | None = None,
) -> list[Path]:
    """Write a study into a folder.

    Args:
        study: what :func:`omtwarp.shape_analysis.study_group` returned.
        folder: made if there is none; files of the same names are replaced.
        names: of the shapes, one each.
        labels: their groups.
        covariates: by name, as :func:`omtwarp.shape_analysis.study_group` had them, for the table.
        like: a file that names the part of the brain that all of them are, for GIFTI.

    Returns:
        The files: ``table.csv`` (distance from the mean, and scores), ``distances.csv`` and, where transport was
        measured, ``transport.csv`` (all pairs); ``mean``, ``component_K_minus`` and ``component_K_plus`` (the mean less
        and plus two standard deviations) as ``.ply``, ``.vtk`` and, where nibabel is installed, ``.surf.gii``; the
        effects are at the mean's vertices, of GIFTI in ``mean.shape.gii``: of each its ``_size``, ``_t`` or ``_F``,
        ``_p`` and ``_fdr`` after its name; ``report.html``.

    Raises:
        OmtwarpError: another number of names, or a folder that cannot be written to.
    """
    if len(names) != len(study.from_mean):
        raise OmtwarpError(f"{len(names)} names for {len(study.from_mean)} shapes")
    make_folder(folder)
    given = table_of(labels, covariates)
    scores = (f"score_{k + 1}" for k in range(len(study.components.deviations)))
    columns = ["id", *given, "from_mean", "scale", *scores]
    rows: list[list[str | float]] = []
    for k, name in enumerate(names):
        numbers = [study.from_mean[k], study.alignment.scales[k], *study.components.scores[k]]
        rows.append([name, *(str(values[k]) for values in given.values()), *map(float, numbers)])
    files = [folder / "table.csv"]
    write_table(files[0], columns, rows)
    for file, distances in (("distances.csv", study.distances), ("transport.csv", study.transport)):
        if distances is not None:
            files.append(folder / file)
            apart = zip(names, distances, strict=True)
            write_table(files[-1], ["id", *names], [[name, *map(float, line)] for name, line in apart])
    beside = {f"{name}_{word}": values for name, one in study.effects.items() for word, values in _maps(one).items()}
    files += _write_shape(folder, "mean", study.mean, like, beside)
    for k in range(len(study.components.deviations)):
        for word, sign in (("minus", -1.0), ("plus", 1.0)):
            files += _write_shape(folder, f"component_{k + 1}_{word}", study.along(k, sign * SHOWN), like, {})
    body = _body(study, columns, rows)
    if study.alignment.mirrored.any():
        body.insert(1, element("p", f"Warning: {mirrored_words(study.alignment, names)}."))
    files.append(write_plain_page(folder / "report.html", "Group of shapes", body))
    return files


def _maps(effect: Effect) -> dict[str, Floats]:
    """Return the maps of an effect, by the ends of their names."""
    size = {} if effect.size is None else {"size": effect.size}
    return {**size, "t" if effect.signed else "F": effect.statistic, "p": effect.p_values, "fdr": effect.fdr}


def _write_shape(
    folder: Path, name: str, surface: Surface, like: Path | None, beside: Mapping[str, Floats]
) -> list[Path]:
    """Write a surface, with numbers at its vertices, in the formats of its readers elsewhere; return the files."""
    files = [folder / f"{name}.ply", folder / f"{name}.vtk"]
    for file in files:
        write_mesh(file, surface.vertices, surface.faces, beside=beside)
    if find_spec("nibabel") is not None:
        files.append(folder / f"{name}.surf.gii")
        write_mesh(files[-1], surface.vertices, surface.faces, like=like)
        if beside:
            data = VertexData(np.column_stack([*beside.values()]), tuple(beside), structure=structure_of(like))
            files.append(folder / f"{name}.shape.gii")
            write_data(files[-1], data)
    return files


def _body(study: GroupStudy, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> list[Markup]:
    most_rows = 200  # of the table on the page; table.csv has all
    known = study.components
    body = [
        element("p", f"{len(rows)} shapes, {len(study.alignment.mean)} corresponding points."),
        element("h2", "Mean"),
        pictures([_picture(study.mean, "mean", view=view) for view in ("front", "back")]),
    ]
    for effect in study.effects.values():
        body += _effect(study, effect)
    lines = [
        (k + 1, f"{deviation:.4g}", f"{100 * share:.1f} %")
        for k, (deviation, share) in enumerate(zip(known.deviations, known.explained, strict=True))
    ]
    shares = table(("component", "standard deviation", "share of the variance"), lines)
    said = f"The mean less and plus {SHOWN:g} standard deviations; red lies outside it, blue inside."
    body += [element("h2", "Principal components"), shares, element("p", said)]
    # Drawn: components with pictures on the page
    for k in range(min(3, len(known.deviations))):
        normals = vertex_normals(study.alignment.mean, study.alignment.faces)
        outward = SHOWN * known.deviations[k] * dots(known.directions[k], normals)
        pair = [(f"component {k + 1}, {word}", sign) for word, sign in (("minus", -1.0), ("plus", 1.0))]
        body.append(pictures([_picture(study.along(k, sign * SHOWN), name, sign * outward) for name, sign in pair]))
    shown = [[f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row] for row in rows[:most_rows]]
    body += [element("h2", "Shapes"), table(columns, shown)]
    if len(rows) > most_rows:
        body.append(element("p", f"The first {most_rows} of {len(rows)}; table.csv has all."))
    return body


def _effect(study: GroupStudy, effect: Effect) -> list[Markup]:
    area = study.mean.vertex_areas
    shares = [float(area[values <= SIGNIFICANT].sum() / area.sum()) for values in (effect.p_values, effect.fdr)]
    words = (
        f"Smallest corrected p {effect.p_values.min():.3g}; p is at most {SIGNIFICANT} on {100 * shares[0]:.1f} %, "
        f"the rate of false discoveries on {100 * shares[1]:.1f} %."
    )
    drawn: list[tuple[str, Floats | ScalarField]] = []
    if effect.size is not None:
        levels = effect.levels
        drawn.append((f"{levels[1]} less {levels[0]}, outwards" if levels else "outwards for 1 more", effect.size))
    for name, values in (("corrected p", effect.p_values), ("rate of false discoveries", effect.fdr)):
        shown = -np.log10(values)
        drawn.append((f"-log10 of the {name}", ScalarField(shown, "magma", (0.0, max(2.0, float(shown.max()))))))
    figures = [_picture(study.mean, name, values, view=view) for name, values in drawn for view in ("front", "back")]
    title = f"What goes with {effect.name}"
    if effect.levels:
        column = "" if effect.name == GROUP[0] else f" ({effect.name})"
        title = f"Where {', '.join(effect.levels[:-1])} and {effect.levels[-1]} differ{column}"
    return [element("h2", title), element("p", words), pictures(figures)]


def _picture(surface: Surface, name: str, values: Floats | ScalarField | None = None, view: str = "front") -> Markup:
    """Return a picture of a surface, with numbers about zero coloured from blue to red where there are any."""
    if isinstance(values, np.ndarray):
        reach = max(float(np.abs(values).max()), np.finfo(float).tiny)
        values = ScalarField(values, "coolwarm", (-reach, reach))
    drawn = preview(
        (surface.vertices, surface.faces), size=(420, 300), views=view, scalar=values, backend="warp", device="cpu"
    )
    return figure(drawn, name, f", {view}")


VIEWS = ("left", "right")


def write_registration_page(path: Path, registration: Registration, moving: SpherePoints, target: SpherePoints) -> Path:
    """Write a page that needs no other file.

    Args:
        path: the file.
        registration: the registration.
        moving: the map that was registered, with its surface where strain is to be drawn on that.
        target: what it was registered to.
    """
    ours, theirs = registration.features
    grid = target.grid
    ball = grid.points[: grid.own_points], grid.own_triangles
    places = (registration.start.sphere, moving.grid.own_triangles), (registration.sphere, moving.grid.own_triangles)
    carried = [resample(place, target, device="cpu") for place in places] if moving.grid.own is None else []
    body = [_facts(registration)]
    for name, values in theirs.items():
        known = values[: grid.own_points]
        ends = float(np.nanquantile(known, 0.02)), float(np.nanquantile(known, 0.98))
        drawn = [_sides(ball, known, "the target", f": {name}", ends)]
        for one, when in zip(carried, ("before", "after"), strict=False):
            agreement = f": {name}, correlation {registration.correlations[name][when]:.3f}"
            drawn.append(_sides(ball, one.apply(ours[name]), when, agreement, ends))
        body += [element("h2", name), pictures(drawn)]
    surface = registration.start.sphere if moving.vertices is None else moving.vertices[: moving.grid.own_points]
    shown = surface, moving.grid.own_triangles
    strains = {"ratios of areas": registration.area_strain, "ratios of stretches": registration.stretch_strain}
    drawn = []
    for name, strain in strains.items():
        values, bound = strain_at_vertices(registration.start.sphere, shown[1], strain), registration.most_strain
        words = f": log2, {np.percentile(np.abs(strain), 95):.2f} at the 95th percentile of triangles"
        drawn.append(_sides(shown, values, name, words, (-bound, bound)))
    return write_plain_page(path, "Registration", [*body, element("h2", "Strain"), pictures(drawn)])


def film_warp(path: Path, registration: Registration, result: MapResult) -> Path:
    """Film a map from the rotation that its warp started from to where it is registered, and on to the sphere.

    Args:
        path: as of :func:`omtwarp.film`.
        registration: the registration.
        result: the map that was registered.
    """
    moved = registration.registered(result).with_arrays({"conformal": registration.start.sphere})
    return film(moved, path, captions=False)


def _facts(registration: Registration) -> Markup:
    """Return the table of agreement and strain, and what is to be known of the start."""
    certificate = registration.certificate
    lines: list[tuple[str, str]] = [
        (f"correlation of {name}", f"{values['before']:.3f} before, {values['after']:.3f} after")
        for name, values in registration.correlations.items()
    ]
    lines += [
        (f"{label}: degrees from its place", f"{apart['before']:.2f} before, {apart['after']:.2f} after")
        for label, apart in registration.landmarks.items()
    ]
    start = f"score {registration.start.score:.3f}, the next best rotation {registration.start.runner_up:.3f}"
    if registration.doubtful:
        start += f"; doubtful, the best of {len(registration.starts)} was taken"
    lines += [
        ("largest strain, log2", f"{registration.largest_strain:.2f} of {registration.most_strain:g} allowed"),
        ("triangles turned over", str(certificate.flips)),
        ("degree", str(certificate.degree)),
        ("start", start),
    ]
    return table(("measure", "value"), lines)


def _sides(mesh: tuple[Floats, Ints], values: Floats, name: str, words: str, ends: tuple[float, float]) -> Markup:
    picture = preview(mesh, size=(360, 300), views=VIEWS, up="z", scalar=values, colormap="coolwarm", scalar_range=ends)
    return figure(picture, name, words)
