"""vestcl.evaluation.statistics on numbers that can be worked out by hand."""

import numpy as np
import pytest

from vestcl.evaluation.scores import Record
from vestcl.evaluation.statistics import Interval, bootstrap, differences, extremes, intervals, unit


def record(clip: str, index: int, method: str = "a", **scores: list[float]) -> Record:
    return Record(clip, f"{index:06}", index, "source", method, 0.0, scores)


def test_two_clips_are_drawn_as_wholes() -> None:
    """Both, or one of them twice (a quarter of the draws each): the ends are the clips' own means."""
    values = [[1.0], [3.0], [8.0]]
    (found,) = bootstrap(values, ["one", "one", "two"])
    assert found == Interval(pytest.approx(4.0), pytest.approx(2.0), pytest.approx(8.0))


def test_equal_windows_leave_no_doubt() -> None:
    found = bootstrap(np.full((6, 2), [0.5, 0.25]), ["a", "a", "b", "c", "c", "c"])
    np.testing.assert_allclose(found, [[0.5] * 3, [0.25] * 3])


def test_intervals_are_those_of_the_normal_distribution() -> None:
    """Mean of 400 draws of deviation 2: 1.96 * 2 / sqrt(400) to either side, within 10 %."""
    values = np.random.default_rng(1).normal(5, 2, (400, 1))
    (found,) = bootstrap(values, [str(i) for i in range(400)])
    half = 1.96 * values.std() / np.sqrt(400)
    assert found.mean == pytest.approx(values.mean())
    assert found.mean - found.low == pytest.approx(half, rel=0.1)
    assert found.high - found.mean == pytest.approx(half, rel=0.1)


def test_windows_of_one_clip_are_drawn_by_themselves() -> None:
    values = np.arange(20.0)[:, None]
    (single,), (apart,) = bootstrap(values, ["one"] * 20), bootstrap(values, [f"{i:02}" for i in range(20)])
    assert single == apart
    assert unit([record("one", 1), record("one", 2)]) == "windows"
    assert unit([record("one", 1), record("two", 1)]) == "clips"


def test_clips_whose_windows_agree_doubt_more_than_windows_would() -> None:
    values, clips = np.repeat([[0.0], [1.0], [2.0], [3.0]], 25, axis=0), np.repeat(list("abcd"), 25)
    (by_clip,), (by_window,) = bootstrap(values, list(clips)), bootstrap(values, [str(i) for i in range(100)])
    assert by_clip.high - by_clip.low > 3 * (by_window.high - by_window.low)


def test_what_is_not_finite_does_not_count() -> None:
    found = bootstrap([[1.0, np.nan], [np.inf, np.nan], [3.0, np.nan]], ["a", "a", "b"])
    assert found[0] == Interval(pytest.approx(2.0), pytest.approx(1.0), pytest.approx(3.0))
    assert np.isnan(found[1]).all()


def test_the_same_numbers_every_time() -> None:
    values, clips = np.random.default_rng(0).random((30, 3)), [str(i % 7) for i in range(30)]
    assert bootstrap(values, clips) == bootstrap(values, clips)


@pytest.mark.parametrize(("values", "clips"), [([1.0], ["a"]), ([[1.0]], ["a", "b"]), (np.zeros((0, 1)), [])])
def test_shapes_that_do_not_fit(values: list[float], clips: list[str]) -> None:
    with pytest.raises(ValueError, match="`values` must be"):
        bootstrap(values, clips)


def test_intervals_by_metric_and_step() -> None:
    records = [record("a", 1, psnr=[10.0, 5.0], squeeze=[1.0, 2.0]), record("b", 1, psnr=[20.0, 5.0], squeeze=[1.0, 2])]
    found = intervals(records)
    assert list(found) == ["psnr", "squeeze"]
    assert found["psnr"][0] == Interval(pytest.approx(15), pytest.approx(10), pytest.approx(20))
    assert found["psnr"][1] == Interval(5, 5, 5)


def test_differences_are_paired() -> None:
    """By window the model is 1 dB better and 0.1 nearer, though windows differ by 10 dB."""
    windows = [(clip, index, 20.0 + 10 * index) for clip in "abc" for index in range(3)]
    base = [record(c, i, "base", psnr=[v], squeeze=[1 / v]) for c, i, v in windows]
    ours = [record(c, i, "ours", psnr=[v + 1], squeeze=[1 / v - 0.1]) for c, i, v in reversed(windows)]
    found = differences(ours, base)
    np.testing.assert_allclose(found["psnr"][0].interval, 1.0)
    np.testing.assert_allclose(found["squeeze"][0].interval, -0.1)
    assert found["psnr"][0].better == found["squeeze"][0].better == 1.0
    assert differences(base, ours)["squeeze"][0].better == 0.0


def test_differences_of_what_both_have() -> None:
    ours = [record("a", 1, psnr=[3.0]), record("a", 2, psnr=[5.0]), record("a", 3, psnr=[np.inf])]
    base = [record("a", 2, psnr=[6.0]), record("a", 3, psnr=[np.inf])]
    (found,) = differences(ours, base)["psnr"]
    assert found.interval.mean == -1.0 and found.better == 0.0
    assert differences(ours, [record("b", 1, psnr=[1.0])]) == {}


def test_extremes() -> None:
    records = [record("a", i, psnr=[0.0, v], squeeze=[0.0, v]) for i, v in enumerate([3.0, 9.0, np.nan, 1.0, 4.0])]
    assert {word: found.index for word, found in extremes(records, "psnr", 2).items()} == {
        "best": 1, "median": 0, "worst": 3
    }  # fmt: skip
    assert extremes(records, "squeeze", 2)["best"].index == 3
    with pytest.raises(ValueError, match="`records` must have psnr at t\\+1"):
        extremes([record("a", 1, psnr=[np.nan])], "psnr", 1)
