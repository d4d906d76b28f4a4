"""Films of maps to a torus, to disks and of several parts begin with the surface and end with the map's domain."""

import numpy as np
import pytest
import trimesh
from drawn_frames import film_frames
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import triangle_areas
from omtwarp.render import films
from omtwarp.render.camera import VIEWS, Camera, camera_axes
from omtwarp.render.films import SPACING, Story, fits_of, story_of

CAMERA = Camera()


@pytest.fixture(scope="module")
def ring() -> omtwarp.MapResult:
    """A ring with a thick side, so that the conformal map is not the optimal one."""
    mesh = trimesh.creation.torus(1.0, 0.3, major_sections=32, minor_sections=12)
    thick = mesh.vertices * np.where(mesh.vertices[:, :1] > 0, 1.3, 1.0)
    return omtwarp.map_surface((thick, mesh.faces), domain="torus")


def bodies(places, sizes) -> tuple[np.ndarray, np.ndarray]:
    blobs = [omtwarp.shapes.blob(seed=seed, sphere=720) for seed in range(len(sizes))]
    vertices = [size * blob.vertices + place for size, blob, place in zip(sizes, blobs, places, strict=True)]
    count = len(blobs[0].vertices)
    return np.concatenate(vertices), np.concatenate([blob.faces + k * count for k, blob in enumerate(blobs)])


def told(result, **options) -> Story:
    given = {"pattern": "circles", "image": None, "width": 96, "up": "z", "front": None, "device": "cpu"} | options
    return story_of(result, view=CAMERA, **given)[0]


def assert_begins_with(story: Story, vertices, faces):
    """Assert that the first moment is the surface, moved and scaled."""
    scale = np.linalg.norm(vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2, axis=1).max()
    part = story.part(0.0)
    area = triangle_areas(part.positions.astype(float), part.faces).sum()
    assert area == pytest.approx(triangle_areas(vertices, faces).sum() / scale**2, rel=1e-5)
    assert np.linalg.norm(part.positions, axis=1).max() == pytest.approx(1.0, abs=1e-6)
    lengths = [np.linalg.norm(story.surface[story.faces[:, 0]] - story.surface[story.faces[:, 1]], axis=1)]
    lengths += [np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1) / scale]
    np.testing.assert_allclose(*lengths, rtol=1e-9)


def test_torus_ends_as_a_ring_torus(ring):
    story = told(ring)
    assert_begins_with(story, ring.vertices, ring.faces)
    assert story.flows and story.captions[3:] == ("to its torus", "the map on the torus")
    points = story.part(2.0).positions.astype(float)
    np.testing.assert_allclose(points, story.domain_points, atol=1e-6)
    # A ring torus: its axis is the direction in which it is thinnest, and the tube a circle around another circle.
    share = np.linalg.norm(ring.lattice, axis=1)
    share = share.min() / share.max()
    thin = np.linalg.svd(story.domain - story.domain.mean(axis=0), full_matrices=False)[2][2]

    def off(guess):
        """Distances of the points from a ring torus: its middle, its axis, and its two radii."""
        axis = guess[3:6] / np.linalg.norm(guess[3:6])
        along = (points - guess[:3]) @ axis
        across = np.linalg.norm(points - guess[:3] - along[:, None] * axis, axis=1)
        return np.hypot(across - guess[6], along) - guess[7]

    found = least_squares(off, [*story.domain.mean(axis=0), *thin, 0.6, 0.2], xtol=1e-15, ftol=1e-15)
    big, small = found.x[6:]
    assert np.abs(off(found.x)).max() < 1e-6 and small / big == pytest.approx(share, rel=1e-5)
    area = triangle_areas(story.surface, story.faces).sum()
    assert 4 * np.pi**2 * big * small == pytest.approx(area, rel=1e-5)
    own, there = (triangle_areas(places, story.faces) for places in (story.surface, story.domain))
    assert 2.0 <= (own / there + there / own).mean() < 2.05  # its triangles keep their areas


def test_pattern_flows_straight_on_the_torus(ring):
    story = told(ring, pattern="checker")
    cut = omtwarp.texture(ring, pattern="checker")
    corner = np.zeros((len(ring.faces), 3), dtype=int)
    points = len(story.first) // len(ring.faces)
    corner[:] = np.arange(len(ring.faces))[:, None] * points + [0, points - 1, int(np.sqrt(2 * points)) - 1]
    for time, places in (
        (0.0, ring.conformal),
        (1.0, ring.coordinates),
        (0.5, (ring.conformal + ring.coordinates) / 2),
    ):
        value = story.part(time).value[corner, :2]
        off = value - places[ring.faces]
        assert np.abs(off - np.rint(off)).max() < (0.51 if time == 0.5 else 1e-5)
        edges = [np.roll(at, -1, axis=1) - at for at in (value, places[ring.faces] + ring.wraps)]
        assert np.abs(edges[0] - edges[1]).max() < 1e-5
    assert story.part(1.0).repeat_rows and story.part(1.0).kind == "uv"
    assert story.image.shape[1] < cut.image.shape[1]  # a small film carries a small picture


@pytest.mark.parametrize("places", [[(0, 0, 0), (4, 0, 0), (0, 4, 0)], [(0, 0, 0), (0, 0, 0), (0.3, 0, 0.1)]])
def test_every_part_ends_as_its_sphere_in_sight(places):
    vertices, faces = bodies(np.array(places, dtype=float), (1.0, 0.5, 0.3))
    result = omtwarp.map_surface((vertices, faces), domain="sphere", components=True, until="moser", device="cpu")
    story = told(result)
    assert_begins_with(story, result.vertices, result.faces)
    assert story.captions[3:] == ("to their spheres", "the map on the spheres")
    end = story.part(2.0)
    points, number = end.positions.astype(float), np.repeat(result.part, len(end.faces) // len(result.faces))
    seen, radii = [], []
    for k in range(3):
        mine = points[np.unique(end.faces[number == k])]
        fit = np.linalg.lstsq(np.column_stack([2.0 * mine, np.ones(len(mine))]), (mine**2).sum(axis=1), rcond=None)[0]
        radius = np.sqrt(fit[3] + (fit[:3] ** 2).sum())
        assert np.abs(np.linalg.norm(mine - fit[:3], axis=1) - radius).max() < 1e-5
        assert 4 * np.pi * radius**2 == pytest.approx(triangle_areas(story.surface, faces[result.part == k]).sum())
        seen.append(fit[:3] @ camera_axes(CAMERA, "z")[:, :2])
        radii.append(radius)
    apart = [np.linalg.norm(seen[i] - seen[j]) / (radii[i] + radii[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(apart) > 1.0
    if places[1][0]:  # none hid another: they stay where they are
        assert min(apart) > SPACING


def facing(story, camera):
    """Return the cosine of the angle between the front of a story's disk and the direction to the camera."""
    corner = story.domain[story.faces]
    front = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
    return front @ camera_axes(camera, "z")[:, 2] / np.linalg.norm(front)


@pytest.fixture(scope="module")
def open_to_the_right() -> omtwarp.MapResult:
    """A ball with a hole at +x, and its map to the disk."""
    ball = omtwarp.shapes.icosphere(6)
    used, faces = np.unique(ball.faces[(ball.vertices[ball.faces, 0] < 0.7).all(axis=1)], return_inverse=True)
    given = ball.vertices[used], faces.reshape(-1, 3)
    return omtwarp.map_surface(given, domain="disk", until="conformal", device="cpu")


@pytest.mark.parametrize("view", ["three-quarter", "front", "back", "left", "right", "top", "bottom"])
def test_a_disk_shows_its_front_from_wherever_it_is_seen(open_to_the_right, view):
    camera = Camera().looking(*VIEWS[view])
    told_here = story_of(open_to_the_right, "circles", None, 96, camera, "z", None, "cpu")[0]
    assert facing(told_here, camera) == pytest.approx(1.0)


def test_a_disk_lies_nearest_to_a_flat_surface_seen_from_its_front(open_to_the_right):
    """A disk that is turned in its plane, and is its own map, comes back to where it was."""
    disk = np.column_stack([open_to_the_right.disk, np.zeros(len(open_to_the_right.vertices))])
    axes = camera_axes(Camera().looking(*VIEWS["top"]), "z")
    faces, turn = open_to_the_right.faces, Rotation.from_euler("z", 130, degrees=True).as_matrix()
    number = np.zeros(len(faces), dtype=int)
    (matrix,), (shift,) = fits_of(disk @ turn.T, disk, faces, number, "disk", axes)
    size = np.linalg.norm(matrix[0])
    np.testing.assert_allclose(disk @ matrix + shift, size * disk @ turn.T, atol=1e-12)


@pytest.mark.parametrize("domain", ["disk", "hemisphere"])
def test_open_surface_ends_as_its_own_domain(domain):
    blob = omtwarp.shapes.blob(seed=3, sphere=1280)
    used, faces = np.unique(blob.faces[(blob.vertices[blob.faces, 2] > -0.3).all(axis=1)], return_inverse=True)
    result = omtwarp.map_surface((blob.vertices[used], faces.reshape(-1, 3)), domain=domain, device="cpu")
    story = told(result)
    assert story.captions[4] == f"the map on the {domain}"
    own, there = (triangle_areas(places, story.faces) for places in (story.surface, story.domain))
    assert own.sum() == pytest.approx(there.sum(), rel=0.01)
    if domain == "disk":
        centred = story.domain - story.domain.mean(axis=0)
        flat = np.linalg.svd(centred, full_matrices=False)[1]
        assert flat[2] < 1e-12 * flat[0]
        assert facing(story, CAMERA) == pytest.approx(1.0)
    else:
        assert np.ptp(np.linalg.norm(story.domain, axis=1)) < 1e-12


def test_frames_are_drawn(ring, monkeypatch):
    """The first frame shows the ring with its hole in the conformal picture, the last one the ring torus."""
    monkeypatch.setattr(films, "PROBE_WIDTH", 24)
    options = {"size": (96, 96), "seconds": 0.5, "fps": 8.0, "captions": False, "view": "top", "up": "z"}
    frames = [np.asarray(one) for one in film_frames(ring, backend="warp", device="cpu", **options)]
    assert len(frames) >= 4 and (frames[0] != frames[-1]).any(axis=2).mean() > 0.1
    for one in (frames[0], frames[-1]):
        assert (one[44:52, 44:52] == 255).all() and 0.3 < (one != 255).any(axis=2).mean() < 0.8
    width = [np.ptp(np.flatnonzero((frame != 255).any(axis=(0, 2)))) for frame in (frames[0], frames[-1])]
    height = [np.ptp(np.flatnonzero((frame != 255).any(axis=(1, 2)))) for frame in (frames[0], frames[-1])]
    assert (
        abs(width[0] - height[0]) > 4 and abs(width[1] - height[1]) <= 2
    )  # the thick side goes, and a round ring is left


def test_a_pattern_of_the_sphere_is_refused_on_a_torus(ring, tmp_path):
    with pytest.raises(OmtwarpError, match="'globe' is for the sphere"):
        omtwarp.film(ring, tmp_path / "film.gif", pattern="globe", size=(64, 64))
