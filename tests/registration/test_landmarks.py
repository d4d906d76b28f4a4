"""Landmarks of registration: points and curves that features do not show are brought together, softly or exactly."""

from __future__ import annotations

import numpy as np
import pytest
from made_cortices import BALL, FIRM, folded, points_of, unit

import omtwarp
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.registration import Landmark, read_landmarks
from omtwarp.registration.landmarks import LandmarkTerm, TermSum, pairs_of

SURFACE = folded(BALL)
PLACES = [40, 700, 1500]


def aside(vertices, degrees=4.0):
    """Places on the sphere so far from those of the features, to one side of each vertex."""
    points = BALL.vertices[vertices]
    side = unit(np.cross(points, [0.3, -0.5, 0.8]))
    return np.cos(np.radians(degrees)) * points + np.sin(np.radians(degrees)) * side


def apart(sphere, vertices, places):
    return np.degrees(np.linalg.norm(sphere[vertices] - places, axis=1))


def registered(landmarks, **options):
    here = points_of(BALL.vertices, SURFACE)
    return omtwarp.register(here, here, landmarks=landmarks, **(FIRM | options))


def test_soft_landmarks_are_the_nearer_the_more_they_weigh():
    """Against features that want them 4 degrees away."""
    places, before = aside(PLACES), 4.0
    for weight in (0.3, 3.0, 30.0):
        found = registered([Landmark(f"p{k}", [v], places[[k]], weight) for k, v in enumerate(PLACES)])
        left = float(apart(found.sphere, PLACES, places).mean())
        assert found.certificate.bijective and found.largest_strain <= 2.0
        assert left < 0.75 * before
        before = left
    assert before < 0.3
    assert found.landmarks["p0"]["after"] == pytest.approx(apart(found.sphere, PLACES[:1], places[:1])[0], rel=1e-3)


def test_exact_landmarks_meet_their_places():
    places = aside(PLACES)
    found = registered([Landmark(f"p{k}", [v], places[[k]], np.inf) for k, v in enumerate(PLACES)])
    assert apart(found.sphere, PLACES, places).max() < 0.01
    assert found.certificate.bijective and found.largest_strain <= 2.0


def test_exact_landmarks_out_of_reach_come_with_a_warning():
    """Two places 10 degrees apart that are to come within 2: the strain that this needs is over the bound."""
    near = np.flatnonzero(np.abs(apart(BALL.vertices, np.arange(BALL.vertex_count), BALL.vertices[40]) - 10.0) < 1.0)
    places = aside([40], 2.0)
    with pytest.warns(OmtwarpWarning, match=r"exact landmarks stayed away .* over 0\.3"):
        found = registered(
            [Landmark("a", [40], BALL.vertices[[40]], np.inf), Landmark("b", near[:1], places, np.inf)], max_strain=0.3
        )
    assert found.certificate.bijective and found.largest_strain <= 0.3


def test_a_curve_meets_another_with_other_points():
    """A line of the target, known by twice as many points, is where the line of the map ends."""
    along = np.radians(np.linspace(-20.0, 20.0, 9))
    line = np.column_stack([np.cos(along), np.sin(along), np.zeros(9)])
    finer = np.radians(np.linspace(-20.0, 20.0, 17))
    lifted = np.radians(4.0 * np.cos(np.pi * finer / finer[-1] / 2.0))
    other = np.column_stack([np.cos(finer) * np.cos(lifted), np.sin(finer) * np.cos(lifted), np.sin(lifted)])
    soft, exact = (registered([Landmark("line", line, other, weight)]) for weight in (3.0, np.inf))
    before, after = soft.landmarks["line"]["before"], soft.landmarks["line"]["after"]
    assert 2.0 < before < 4.0 and after < 0.5 * before
    assert exact.landmarks["line"]["after"] < 0.1
    assert exact.certificate.bijective


def test_points_without_features_are_brought_together_by_landmarks_alone():
    """One feature, which does not vary along circles of latitude: what turns about the axis is the landmarks'."""
    z = BALL.vertices[:, 2]
    height = {"height": np.cos(5.0 * np.arccos(z))}
    places = BALL.vertices[PLACES] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # 90 degrees
    marks = [Landmark(f"p{k}", [v], places[[k]]) for k, v in enumerate(PLACES)]
    here = points_of(BALL.vertices, None)
    found = omtwarp.register(here, here, features=height, to_features=height, landmarks=marks)
    assert apart(found.sphere, PLACES, places).max() < 1.0
    assert found.largest_strain < 0.3


def test_the_term_is_what_it_says():
    """Value by its sum, gradient by differences, and a matrix that bounds the change of the gradient."""
    places = aside(PLACES)
    marks = [
        Landmark(f"p{k}", 0.4 * BALL.vertices[[v]] + 0.6 * BALL.vertices[[v + 1]], places[[k]], 2.0)
        for k, v in enumerate(PLACES)
    ]
    pairs = pairs_of(marks, BALL.vertices, BALL.vertices, (BALL.vertex_count,) * 2)
    term = LandmarkTerm(pairs, BALL, 0.5)
    at = term.at(BALL.vertices)
    assert at.value == pytest.approx(0.5 * 2.0 * ((pairs.points - places) ** 2).sum(), rel=1e-9)
    step = np.cross(BALL.vertices, np.random.default_rng(0).normal(size=BALL.vertices.shape))
    ahead, behind = (term.at(unit(BALL.vertices + t * step)).value for t in (1e-4, -1e-4))
    assert float((at.gradient * step).sum()) == pytest.approx((ahead - behind) / 2e-4, rel=1e-5)
    bend = (ahead + behind - 2.0 * at.value) / 1e-8
    assert np.einsum("vd,vde,ve->", step, at.hessian, step) > 0.9 * bend
    twice = TermSum([term, term]).at(BALL.vertices)
    assert twice.value == pytest.approx(2.0 * at.value)
    np.testing.assert_allclose(twice.gradient, 2.0 * at.gradient)


def test_a_table_holds_points_and_curves_of_both_sides(tmp_path):
    file = tmp_path / "places.csv"
    file.write_text(
        "label,side,vertex,x,y,z,weight\npole,moving,120,,,,exact\nline,moving,5,,,,2.5\npole,target,,0,0,2,\n"
        "line,moving,9,,,,\nline,target,3,,,,\nline,target,8,,,,\nline,target,7,,,,\n"
    )
    pole, line = read_landmarks(file)
    assert (pole.label, pole.weight, line.label, line.weight) == ("pole", np.inf, "line", 2.5)
    np.testing.assert_array_equal(pole.target, [[0.0, 0.0, 2.0]])
    np.testing.assert_array_equal(line.moving, [5, 9])
    np.testing.assert_array_equal(line.target, [3, 8, 7])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name,side,vertex\n", "no column 'label'"),
        ("label,side,vertex\na,left,1\n", "line 2: the side is 'left'"),
        ("label,side,vertex,weight\na,moving,1,2\na,target,1,exact\n", "line 3: landmark 'a' has another weight"),
        ("label,side,vertex\na,moving,one\n", "line 2: give a vertex"),
        ("label,side,vertex\n\na,moving,1\n\na,right,1\n", "line 5: the side is 'right'"),
        ("label,side,vertex\na,moving,1\n", "no row with the side 'target'"),
        ("label,side,vertex\n", "no landmarks"),
        ("label,side,vertex\na,moving,1\na,target,99999\n", "landmark 'a' on the target"),
        ("label,side,vertex\na,moving,1\na,target,2\na,target,3\n", "a point on one side and a curve on the other"),
        ("label,side,vertex,weight\na,moving,1,-2\na,target,2,\n", "weight of 'a'"),
        (
            "label,side,vertex,weight\na,moving,1,nan\na,target,2,nan\n",
            "line 2: weight of 'a': must be a finite number above 0, not nan",
        ),
        ("label,side,vertex,weight\na,moving,1,2\na,target,2,nan\n", "line 3: weight of 'a': must be a finite number"),
        ("label,side,x,y,z\na,moving,0,0,0\na,target,0,0,1\n", "at the centre"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path, text, words):
    file = tmp_path / "places.csv"
    file.write_text(text)
    with pytest.raises(OmtwarpError, match=words) as caught:
        registered(file)
    assert "\n" not in str(caught.value)


def test_labels_that_are_no_text_are_read_as_text():
    points = BALL.vertices
    pairs = pairs_of([Landmark([], [1], [1]), Landmark(2, [2], [2])], points, points, (len(points), len(points)))
    assert pairs.distances(pairs.places) == {"[]": 0.0, "2": 0.0}


def test_two_landmarks_of_one_name_are_refused():
    with pytest.raises(OmtwarpError, match="two landmarks are called 'a'"):
        registered([Landmark("a", [1], [1]), Landmark("a", [2], [2])])


@pytest.mark.parametrize(
    "landmarks", [3, [None], [("a", 1, 2)], [{"label": "a"}], Landmark("a", 1, 2), [Landmark("a", [[0, 1], [1]], 2)]]
)
def test_what_is_no_list_of_landmarks_is_refused(landmarks):
    """What is no landmark, and points in rows of unequal length, are refused in one line; a generator is a list."""
    points, counts = BALL.vertices, (BALL.vertex_count, BALL.vertex_count)
    with pytest.raises(OmtwarpError, match=r"landmarks: must be a list of .*Landmark|'a' on the map: must be numbers"):
        pairs_of(landmarks, points, points, counts)
    assert pairs_of((Landmark(name, 1, 2) for name in "ab"), points, points, counts).labels == ("a", "b")
