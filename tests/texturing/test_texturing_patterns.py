"""The built-in patterns against what they are defined to be."""

from pathlib import Path

import numpy as np
import pytest
from pattern_areas import cell_areas, cells
from scipy import ndimage
from texturing_shapes import ellipsoid, rotation, texel_directions, unit

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import direction_from_angles
from omtwarp.options import PatternName
from omtwarp.texturing import pattern, patterns, rasterize
from omtwarp.texturing.patterns import Pattern
from omtwarp.texturing.patterns.checker import Checker
from omtwarp.texturing.patterns.circles import Circles
from omtwarp.texturing.patterns.globe import Globe, coastline_segments
from omtwarp.texturing.patterns.puzzle import Puzzle


def directions(count=4000, seed=0):
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def degrees(lon, lat):
    return direction_from_angles(np.deg2rad(lon), np.deg2rad(lat)).reshape(-1, 3)


@pytest.mark.parametrize("name", PatternName)
def test_colours_are_colours_and_do_not_depend_on_length(name):
    d = directions()
    colours = pattern(name)(d)
    assert colours.shape == (len(d), 3) and colours.min() >= 0 and colours.max() <= 1
    assert np.array_equal(pattern(name)(d), colours)
    assert np.mean(np.abs(pattern(name)(3.7 * d) - colours).max(axis=1) > 1e-9) < 1e-3  # only on the very edges
    assert len(np.unique(colours.round(3), axis=0)) >= 2


@pytest.mark.parametrize("name", PatternName)
def test_no_seam_where_longitude_wraps_and_none_at_a_pole(name):
    """Two directions a hair apart have the same colour almost always, on both sides of the date line too."""
    lat = np.linspace(-88, 88, 3001) + 0.0137
    east, west = degrees(180 - 1e-7, lat), degrees(-180 + 1e-7, lat)
    if name == "checker":  # 180 degrees is an edge of the fields: there the colours must all differ
        assert np.all(np.any(pattern(name)(east) != pattern(name)(west), axis=1))
    else:
        changed = np.abs(pattern(name)(east) - pattern(name)(west)).max(axis=1) > 0.02
        assert changed.mean() < 0.002
        around = pattern(name)(degrees(np.linspace(-179.9, 179.9, 50), 89.99))
        assert np.ptp(around, axis=0).max() < 0.05


def test_checker_has_its_fields():
    """Count the fields by labelling a picture of the pattern, the date line and the poles cut open."""
    picture = Checker(16, 6)(texel_directions(480, 240).reshape(-1, 3)).reshape(240, 480, 3)
    dark = picture[..., 0] < 0.5
    assert ndimage.label(dark)[1] == ndimage.label(~dark)[1] == 16 * 6 // 2
    assert pattern("checker").columns == 24 and pattern("checker").rows == 12


def test_checker_cells_agree_with_its_colours():
    checker, d = Checker(10, 5), directions()
    cell = cells(checker, d)
    assert set(cell) == set(range(50))
    parity = (cell // 10 + cell % 10) % 2
    np.testing.assert_array_equal(checker(d), checker.colours[parity])


@pytest.mark.parametrize("count", [12, 42, 100, 162, 500])
def test_circles_are_even_equal_and_apart(count):
    circles = Circles(count, coverage=0.5)
    assert len(circles.centres) == count
    np.testing.assert_allclose(np.linalg.norm(circles.centres, axis=1), 1.0, atol=1e-12)
    assert count * (1 - np.cos(circles.radius)) / 2 == pytest.approx(0.5)
    gram = np.arccos(np.clip(circles.centres @ circles.centres.T - 2 * np.eye(count), -1, 1))
    nearest = gram.min(axis=1)
    assert nearest.min() > 2 * circles.radius, "no two circles touch"
    assert nearest.max() / nearest.min() < 1.35, "no gap is much wider than another"
    near = gram < 1.05 * nearest[:, None]
    assert not np.any(near & (circles.groups[:, None] == circles.groups)), "neighbours differ in colour"


def test_circles_cover_equal_areas_of_the_sphere():
    """Each circle's share of evenly spread points is its share of the area; the colours say the same as the numbers."""
    circles = pattern("circles")
    k = np.arange(600_000) + 0.5
    points = degrees(np.rad2deg(k * np.pi * (3 - 5**0.5)), np.rad2deg(np.arcsin(1 - 2 * k / len(k))))
    cell = cells(circles, points)
    share = np.bincount(cell[cell >= 0], minlength=circles.count) / len(points)
    np.testing.assert_allclose(share, (1 - np.cos(circles.radius)) / 2, rtol=0.02)
    some = points[::50]
    background = np.all(circles(some) == circles.background, axis=1)
    np.testing.assert_array_equal(background, cells(circles, some) < 0)


def test_areas_on_a_surface_tell_a_fair_map_from_an_unfair_one():
    """A round sphere mapped by the identity keeps all circles equal; a map that squeezes a half does not."""
    circles = Circles(92)
    _, faces, sphere = ellipsoid(5, seed=1, strength=0.0)
    fair = cell_areas(circles, 3.0 * sphere, faces, sphere)
    np.testing.assert_allclose(fair, 9 * 2 * np.pi * (1 - np.cos(circles.radius)), rtol=0.02)
    _, faces, squeezed = ellipsoid(5, seed=1, strength=0.5)
    assert np.std(cell_areas(circles, sphere, faces, squeezed)) / fair.mean() * 9 > 0.15
    everything = cell_areas(Checker(6, 3), 3.0 * sphere, faces, sphere)
    assert everything.sum() == pytest.approx(9 * 4 * np.pi, rel=0.01)


@pytest.mark.parametrize("side", [1, 3, 4])
def test_puzzle_pieces_fit(side):
    """Every edge belongs to two pieces that know each other, exactly one of which has the tab."""
    puzzle = Puzzle(side)
    neighbours, tabs, shifts = puzzle._edges
    assert puzzle.count == 6 * side**2 == len(neighbours)
    for piece in range(puzzle.count):
        assert len(set(neighbours[piece])) == 4 and piece not in neighbours[piece]
        for edge, other in enumerate(neighbours[piece]):
            back = list(neighbours[other]).index(piece)
            assert tabs[piece, edge] + tabs[other, back] == 1
            assert abs(shifts[piece, edge]) == pytest.approx(abs(shifts[other, back]))
    piece = np.arange(puzzle.count)
    middles = puzzle(puzzle._points(piece // side**2, piece % side + 0.5, piece // side % side + 0.5))
    same = np.all(np.abs(middles[neighbours] - middles[:, None]) < 1e-3, axis=2)
    assert not same.any(), "neighbouring pieces differ in colour"


def test_puzzle_tabs_meet_across_faces_of_the_cube():
    """The outline is one line: a tab's colour inside the neighbour is its piece's, and areas add up to the sphere."""
    puzzle = Puzzle(3)
    picture = puzzle(texel_directions(720, 360).reshape(-1, 3)).reshape(360, 720, 3)
    line = np.all(np.abs(picture - puzzle.line_colour) < 1e-9, axis=2)
    weight = np.cos((0.5 - (np.arange(360) + 0.5) / 360) * np.pi)[:, None]
    drawn = (line * weight).sum() / (weight.sum() * 720)
    assert 0.05 < drawn < 0.2
    # Without its lines the puzzle falls into its pieces, glued together where longitude wraps.
    labels, count = ndimage.label(~line)
    for row in range(360):
        if not line[row, 0] and not line[row, -1] and labels[row, 0] != labels[row, -1]:
            labels[labels == labels[row, -1]] = labels[row, 0]
    sizes = ndimage.sum_labels(np.broadcast_to(weight, labels.shape), labels, np.unique(labels[labels > 0]))
    assert np.count_nonzero(sizes > 0.2 * sizes.max()) == puzzle.count, count


def test_globe_knows_the_world():
    globe = pattern("globe", step=90.0)
    land, ice, sea = globe.palette[3], globe.palette[4], globe.palette[0]

    def blue(lon, lat):
        colour = globe(degrees(lon, lat))[0]
        return colour[2] > colour[0] + 0.1

    on_land = [(20, 5), (-100, 45), (-60, -10), (135, -25), (100, 35), (10, 50), (-3, 40), (47, -20)]
    at_sea = [(-30, 30), (-150, 10), (80, -30), (5, 40), (50, 42), (-90, 25), (-140, -40), (0.5, 85)]
    assert not any(blue(*place) for place in on_land)
    assert all(blue(*place) for place in at_sea)
    np.testing.assert_allclose(globe(degrees(20.3, 5.2))[0], land, atol=1e-6)
    np.testing.assert_allclose(globe(degrees(100.3, -85.2))[0], ice, atol=1e-6)
    assert not np.allclose(land, sea)


def test_globe_has_the_land_area_of_the_earth():
    """29 percent of the sphere is land; the coast forms closed rings."""
    segments = coastline_segments()
    starts, ends = ({tuple(p) for p in segments[:, k]} for k in (0, 1))
    assert starts == ends
    k = np.arange(100_000) + 0.5
    points = degrees(np.rad2deg(k * np.pi * (3 - 5**0.5)), np.rad2deg(np.arcsin(1 - 2 * k / len(k))))
    colour = pattern("globe")(points)
    share = np.mean(colour[:, 2] < colour[:, 0] + 0.05)
    assert 0.26 < share < 0.34


def test_globe_agrees_with_a_plain_point_in_polygon_test():
    """The table of cells gives the same land as crossing all coasts one by one."""
    rng = np.random.default_rng(5)
    lon, lat = rng.uniform(-179, 179, 400), rng.uniform(-80, 80, 400)
    a, b = coastline_segments().transpose(1, 0, 2)
    cut = (a[:, 1] < lat[:, None]) != (b[:, 1] < lat[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (lat[:, None] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    land = np.count_nonzero(cut & (x < lon[:, None]), axis=1) % 2 == 1
    globe = Globe()
    globe.line_width = -1.0  # no graticule over the colours
    colour = globe(degrees(lon, lat))
    sea_colour = colour[:, 2] > colour[:, 0] + 0.05
    coast = np.all(np.abs(colour - pattern("globe").palette[5]) < 1e-9, axis=1)
    np.testing.assert_array_equal(land[~coast], ~sea_colour[~coast])


def test_rasterize_a_checker():
    picture = rasterize("checker", 256)
    assert picture.shape == (128, 256, 3) and picture.dtype == np.uint8
    assert len(np.unique(rasterize("checker", 240).reshape(-1, 3), axis=0)) == 2, "here edges lie between texels"


def test_supersampling_blends_across_an_edge():
    picture = rasterize("circles", 128, supersample=4).reshape(-1, 3)
    hard = rasterize("circles", 128, supersample=1).reshape(-1, 3)
    assert len(np.unique(hard, axis=0)) == 13
    assert len(np.unique(picture, axis=0)) > 100


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("stripes", {}, "circles, puzzle, globe, checker"),
        ("checker", {"columns": 7}, "even"),
        ("checker", {"size": 7}, "size"),
        ("circles", {"count": 2}, "4 to 20000"),
        ("circles", {"coverage": 0.95}, "touch"),
        ("puzzle", {"side": 0}, "1 to 64"),
        ("globe", {"step": 7}, "divisor of 90"),
    ],
)
def test_bad_patterns_are_named(name, options, message):
    with pytest.raises(OmtwarpError, match=message):
        pattern(name, **options)


def test_rotating_directions_moves_the_pattern_and_nothing_else():
    turn, d = rotation(3), directions(50_000, seed=2)
    a, b = pattern("circles")(d), pattern("circles")(d @ turn)
    assert abs(np.mean(a, axis=0) - np.mean(b, axis=0)).max() < 0.01


def test_a_pattern_is_a_file_and_a_name():
    """Every name has a file with a class of that name, a title, and no other file is there."""
    folder = Path(patterns.__file__).parent
    assert {file.stem for file in folder.glob("*.py")} - {"__init__", "base", "kernels"} == set(PatternName)
    for name in PatternName:
        made = pattern(name)
        assert isinstance(made, Pattern) and type(made).__name__ == name.capitalize() and made.name == name
        assert made.title != Pattern.title
