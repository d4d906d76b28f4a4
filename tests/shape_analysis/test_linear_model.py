"""Linear models at points against closed forms of SciPy, nilearn's permutations, and effects that are known."""

import numpy as np
import pytest
from scipy import stats

from omtwarp.errors import OmtwarpError
from omtwarp.shape_analysis import linear_effects

COUNT, POINTS = 24, 40
RNG = np.random.default_rng(4)
AGE, SEX, SITE = RNG.normal(60.0, 8.0, COUNT), ["f", "m"] * (COUNT // 2), ["east", "north", "west"] * (COUNT // 3)
NOISE = RNG.normal(size=(COUNT, POINTS))


def test_two_groups_are_compared_by_students_t():
    found = linear_effects(NOISE, {"sex": SEX}, permutations=20)["sex"]
    men, women = NOISE[1::2], NOISE[::2]
    np.testing.assert_allclose(found.statistic, stats.ttest_ind(men, women).statistic, rtol=1e-9)
    np.testing.assert_allclose(found.size, men.mean(axis=0) - women.mean(axis=0), rtol=1e-9, atol=1e-12)
    assert found.signed and found.levels == ("f", "m")


def test_more_groups_are_compared_by_fishers_f():
    found = linear_effects(NOISE, {"site": SITE}, permutations=20)["site"]
    np.testing.assert_allclose(found.statistic, stats.f_oneway(*(NOISE[k::3] for k in range(3))).statistic, rtol=1e-9)
    assert not found.signed and found.size is None


def test_a_number_is_a_regression():
    found = linear_effects(NOISE, {"age": AGE}, permutations=20)["age"]
    for k in (0, 7):
        wanted = stats.linregress(AGE, NOISE[:, k])
        assert found.size[k] == pytest.approx(wanted.slope)
        assert found.statistic[k] == pytest.approx(wanted.slope / wanted.stderr)


def test_each_column_is_tested_given_the_others():
    """F is the fall of squared residuals that a column brings to the model of all others."""
    model = {"age": AGE[:, None], "sex": np.array([[s == "m"] for s in SEX], float)}
    model["site"] = np.array([[s == "north", s == "west"] for s in SITE], float)

    def left(*names):
        columns = np.column_stack([np.ones(COUNT), *(model[name] for name in names)])
        return ((NOISE - columns @ np.linalg.lstsq(columns, NOISE, rcond=None)[0]) ** 2).sum(axis=0)

    whole = left(*model)
    for name, found in linear_effects(NOISE, {"age": AGE, "sex": SEX, "site": SITE}, permutations=20).items():
        width = model[name].shape[1]
        wanted = (left(*(set(model) - {name})) - whole) / width / (whole / (COUNT - 5))
        np.testing.assert_allclose(found.statistic**2 if found.signed else found.statistic, wanted, rtol=1e-8)


def test_several_values_at_a_point_have_hotellings_statistic():
    surfaces, chosen = np.random.default_rng(1).normal(size=(12, 42, 3)), np.arange(12) < 5
    found = linear_effects(surfaces, {"side": np.where(chosen, "b", "a")}, permutations=50)["side"]
    for k in (0, 17):
        one, other = surfaces[~chosen, k], surfaces[chosen, k]
        pooled = (6 * np.cov(one.T) + 4 * np.cov(other.T)) / 10
        apart = one.mean(axis=0) - other.mean(axis=0)
        assert found.statistic[k] == pytest.approx(7 * 5 / 12 * apart @ np.linalg.solve(pooled, apart), rel=1e-9)


def test_p_values_are_those_of_nilearn():
    """Its permuted OLS, an independent Freedman-Lane, within what two draws of 2,000 permutations differ by."""
    permuted_ols = pytest.importorskip("nilearn.mass_univariate").permuted_ols
    values = NOISE + 0.06 * AGE[:, None] * (np.arange(POINTS) < 3)
    others = np.array([[s == "m", p == "north", p == "west"] for s, p in zip(SEX, SITE, strict=True)], float)
    theirs = permuted_ols(AGE[:, None], values, others, n_perm=2000, random_state=1)
    found = linear_effects(values, {"age": AGE, "sex": SEX, "site": SITE}, permutations=2000)["age"]
    np.testing.assert_allclose(found.statistic, theirs["t"][0], rtol=1e-8)
    np.testing.assert_allclose(found.p_values, 10.0 ** -theirs["logp_max_t"][0], atol=0.05)


def test_family_and_discoveries_are_corrected_as_they_say():
    """No effect: the chance of any finding is the level. One at a third of the points: discoveries find them."""
    any_found = []
    for seed in range(60):
        noise = np.random.default_rng(seed).normal(size=(12, POINTS))
        found = linear_effects(noise, {"group": ["a", "b", "c"] * 4}, permutations=99, seed=seed)["group"]
        any_found.append(found.p_values.min() <= 0.05)
    assert np.mean(any_found) <= 0.05 + 2.6 * np.sqrt(0.05 * 0.95 / 60)
    there = np.arange(POINTS) < POINTS // 3
    found = linear_effects(NOISE + 0.08 * AGE[:, None] * there, {"age": AGE}, permutations=499)["age"]
    share = (found.fdr <= 0.05)[there].mean()
    assert share >= (found.p_values <= 0.05)[there].mean() and share > 0.5
    assert (found.fdr <= 0.05)[~there].mean() < 0.1


def test_the_same_seed_gives_the_same_result_and_a_confounder_is_taken_out():
    """What sites differ by is explained by a group that is uneven over them, unless they are in the model."""
    site = np.repeat(["x", "y"], COUNT // 2)
    group = np.where(np.arange(COUNT) % 12 < np.where(site == "x", 2, 10), "a", "b")
    values = NOISE + 3.0 * (site == "y")[:, None]
    alone, again = (linear_effects(values, {"group": group}, seed=5)["group"] for _ in range(2))
    np.testing.assert_array_equal(alone.p_values, again.p_values)
    given = linear_effects(values, {"group": group, "site": site}, seed=5)["group"]
    assert alone.p_values.min() < 0.01 < given.p_values.min()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"age": [None, *AGE[1:]]}, "column 'age' has no value in row 1 of 24"),
        ({"sex": [*SEX[1:], ""]}, "no value in row 24"),
        ({"sex": ["m"] * COUNT}, "'m' in all rows"),
        ({"age": [60, 60.0] * (COUNT // 2)}, "60 in all rows"),
        ({"age": [*AGE[1:], np.inf]}, "not finite"),
        ({"age": AGE[1:]}, "23 values for 24 shapes"),
        ({"site": SITE, "again": SITE}, "follows from the other columns"),
        ({"age": AGE, "months": 12.0 * AGE}, "follows from the other columns"),
        ({"age": AGE, "site": SITE, "again": SITE}, "column 'site' follows from the other columns"),
        ({"site": ["alone", *SITE[1:]]}, "too few shapes with 'alone'"),
        ({f"x{k}": RNG.normal(size=COUNT) for k in range(23)}, "too few shapes for a model"),
    ],
)
def test_tables_that_cannot_be_tested_are_one_line(table, words):
    with pytest.raises(OmtwarpError, match=words) as caught:
        linear_effects(NOISE, table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "table", "factors", "words"),
    [
        ([["a", "b"]] * COUNT, {"age": AGE}, (), "values: must be real numbers, not text"),
        (1j * NOISE, {"age": AGE}, (), "values: must be real numbers, not complex numbers"),
        ([[1.0], [1.0, 2.0]], {"age": AGE}, (), "rows of equal length"),
        (NOISE, [AGE], (), "the table: must be a dictionary"),
        (NOISE, {"age": 60.0}, (), "column 'age': must be a list of values"),
        (NOISE, {"age": AGE}, ["site"], "the table has no column 'site', which the factors name"),
    ],
)
def test_what_is_no_table_of_numbers_is_one_line(values, table, factors, words):
    with pytest.raises(OmtwarpError, match=words):
        linear_effects(values, table, factors=factors)


@pytest.mark.parametrize("wrong", [{"permutations": 0}, {"permutations": "9"}, {"permutations": True}, {"seed": -1}])
def test_numbers_that_count_nothing_are_one_line(wrong):
    with pytest.raises(OmtwarpError, match="must be a whole number"):
        linear_effects(NOISE, {"age": AGE}, **wrong)


def test_numbers_of_factors_are_words():
    numbered = [1, 2, 3] * (COUNT // 3)
    found = linear_effects(NOISE, {"site": numbered}, factors=["site"], permutations=9)["site"]
    wanted = linear_effects(NOISE, {"site": SITE}, permutations=9)["site"]
    np.testing.assert_allclose(found.statistic, wanted.statistic)


def test_points_without_a_number_are_not_tested_and_change_nothing():
    """A medial wall is NaN, or masked."""
    values = NOISE.copy()
    values[:, 5], values[3, 9] = np.nan, np.inf
    alone = linear_effects(np.delete(NOISE, [5, 9], axis=1), {"age": AGE}, permutations=30)["age"]
    for given in (values, np.ma.array(NOISE, mask=~np.isfinite(values))):
        found = linear_effects(given, {"age": AGE}, permutations=30)["age"]
        for name in ("statistic", "size", "p_values", "fdr"):
            assert np.flatnonzero(np.isnan(getattr(found, name))).tolist() == [5, 9]
            np.testing.assert_array_equal(np.delete(getattr(found, name), [5, 9]), getattr(alone, name))
    for bad, words in ((NOISE[0], "have the shape"), (np.full((COUNT, 3), np.nan), "no point")):
        with pytest.raises(OmtwarpError, match=words):
            linear_effects(bad, {"age": AGE})


def test_a_statistic_depends_on_its_own_point_and_on_no_unit():
    alone = linear_effects(NOISE, {"age": AGE}, permutations=20)["age"].statistic
    beside = linear_effects(np.column_stack([NOISE, 1e9 * NOISE[:, :1]]), {"age": AGE}, permutations=20)[
        "age"
    ].statistic
    np.testing.assert_allclose(beside, np.append(alone, alone[0]), rtol=1e-9)
    pairs = RNG.normal(size=(COUNT, 6, 2))
    one, other = (linear_effects(pairs * units, {"sex": SEX}, permutations=20)["sex"] for units in (1.0, [1e-6, 1e6]))
    np.testing.assert_allclose(one.statistic, other.statistic, rtol=1e-6)
    constant = np.column_stack([NOISE, np.full(COUNT, 0.1)])  # varies by nothing but rounding
    assert linear_effects(constant, {"age": AGE}, permutations=20)["age"].statistic[-1] == 0.0
