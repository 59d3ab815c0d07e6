"""vestcl.models.inference.stage_times: stages timed without a change of the model, each thread's forecasts by
themselves."""

import copy
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, camera, frame, measured, stir

from vestcl.clock import Clock
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network.forecast import forecast_clip, forecast_frames
from vestcl.forecasting.result import Forecast, View
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.fast import accelerate
from vestcl.models.inference.skipping import Count, count_skips, current_tally
from vestcl.models.inference.stage_times import REST, STAGES, watching, with_rest
from vestcl.opencl import trace

HEIGHT, WIDTH = 32, 64
SOURCE = View("source", np.eye(4))


def model() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SMALL)).eval()


def run(network: Forecaster, seed: int = 1, views: int = 1) -> torch.Tensor:
    """The image."""
    generator = torch.Generator().manual_seed(seed)
    K, prior = camera(1, HEIGHT, WIDTH), measured(1, HEIGHT, WIDTH, cur=(0.1, 0, -0.8))
    pair = [frame(1, HEIGHT, WIDTH) for _ in range(2)]
    for each in pair:
        each.image.copy_(torch.rand(each.image.shape, generator=generator))
    with torch.inference_mode():
        return network(*pair, K, [(torch.eye(4)[None], K)] * views, prior=prior).views[0].image


def test_the_stopwatch_sums_stages_up() -> None:
    with watching() as outer, watching() as watch:
        for _ in range(2):
            with watch.time("a"):
                pass
        once = watch.seconds["a"]
        with watch.time("a"), watch.time("b"):
            sum(range(10_000))
    assert watch.seconds["a"] > once and watch.seconds["b"] <= watch.seconds["a"]
    assert set(watch.cpu_seconds) == {"a", "b"} and outer.seconds == watch.seconds


def test_all_stages_are_timed_and_the_model_is_as_it_was() -> None:
    network = model()
    before, inside = dict(vars(network)), list[dict[str, Any]]()
    with watching(lambda *_: inside.append(dict(vars(network)))) as watch:
        run(network)
    assert list(watch.seconds) == list(STAGES.values()) and min(watch.seconds.values()) > 0
    assert len(inside) == len(STAGES) + 1, "encode comes twice"
    for now in (*inside, vars(network)):
        assert now.keys() == before.keys() and all(now[name] is value for name, value in before.items())
    taken = watch.take()
    assert watch.seconds == {} and list(with_rest(taken, 1e3)) == [*STAGES.values(), REST]
    run(network)
    assert watch.seconds == {}, "after the block nothing is timed"


def test_blocks_inside_blocks() -> None:
    """The outer clock and tally have all of the inner one, and what comes after it."""
    network = model()
    with watching() as outer, count_skips() as whole:
        with watching() as inner, count_skips() as part:
            run(network, views=3)
        assert inner.seconds == outer.seconds
        assert part == whole and part.counts["views"] == Count(2, 3, "views")
        run(network)
    assert all(outer.seconds[name] > inner.seconds[name] for name in ("lift", "splat", "refine"))
    assert whole.counts["views"] == Count(2, 4, "views") and part.counts["views"] == Count(2, 3, "views")
    assert current_tally().counts == {}


def test_a_stage_that_fails_is_timed_and_ends_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    network = model()
    monkeypatch.setattr(network.refine, "forward", lambda rendered: 1 / 0)
    with watching() as watch, pytest.raises(ZeroDivisionError):
        run(network)
    assert watch.seconds["refine"] > 0
    with watching() as again:
        pass
    assert again.outer is None and again.seconds == {}


def test_results_are_shown_by_stage() -> None:
    shown: dict[str, Any] = {}
    with watching(shown.__setitem__):
        image = run(model())
    assert shown.keys() == set(STAGES.values()) and torch.equal(shown["refine"], image)


def test_torchs_profiler_sees_the_stages() -> None:
    network = model()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        run(network)
    names = [event.name for event in profile.events()]
    assert {name: names.count(name) for name in STAGES.values()} == dict.fromkeys(STAGES.values(), 1) | {"encode": 2}


def test_a_trace_sees_the_stages(tmp_path: Path) -> None:
    with trace.record(tmp_path / "trace.json"):
        run(model())
    text = (tmp_path / "trace.json").read_text()
    assert all(f'"name": "{name}"' in text for name in STAGES.values())


# ---------------------------------------------------------------- two at once


def at_once(*tasks: Callable[[], Any]) -> list[Any]:
    """Their results, of a thread each, begun together."""
    barrier = threading.Barrier(len(tasks))

    def begun(task: Callable[[], Any]) -> Any:
        barrier.wait()
        return task()

    with ThreadPoolExecutor(len(tasks)) as pool:
        return [future.result() for future in [pool.submit(begun, task) for task in tasks]]


def drive(seed: int) -> Clip:
    return street_clip(Street.generate(seed), 3, 48, 96)


def assert_same(got: Forecast, wanted: Forecast) -> None:
    assert len(got.frames) == len(wanted.frames)
    for one, other in zip(got.frames, wanted.frames, strict=True):
        assert one.keys() == other.keys()
        for view in one:
            for part in ("image", "depth", "coverage", "motion_xyz"):
                assert np.array_equal(getattr(one[view], part), getattr(other[view], part))


@pytest.mark.parametrize("quick", [False, True])
def test_two_forecasts_at_once_on_one_model(quick: bool) -> None:
    """Each has the images, the times and the counts that it has by itself."""
    network = accelerate(model()) if quick else model()
    perceptions = [Perception(drive(seed)) for seed in (3, 4)]
    few, many = [SOURCE], [SOURCE, View("again", np.eye(4)), View("third", np.eye(4))]

    def task(network: Forecaster, number: int) -> Forecast:
        steps, views = ((2, few), (3, many))[number]
        return forecast_frames(perceptions[number], network, 2, steps, views, learned="all")

    wanted = [task(copy.deepcopy(network), number) for number in range(2)]
    before = dict(vars(network))
    for known in range(3):
        found = at_once(*(lambda number=number: task(network, number) for number in range(2)))
        assert all(vars(network)[name] is value for name, value in before.items())
        for got, single, (shown, twice) in zip(found, wanted, ((2, 0), (9, 6)), strict=True):
            assert_same(got, single)
            assert list(got.profile) == [*STAGES.values(), REST]
            assert sum(got.profile.values()) == pytest.approx(got.seconds["network"], rel=1e-6)
            assert all(got.profile[name] > 0 for name in STAGES.values())
            assert got.skipped["views"][:3] == (twice, shown, "views")
            assert got.skipped["seen"][:3] == (2 * (known > 0), 2, "frames")
            for switch in got.skipped.keys() - {"seen", "background"}:  # what is known is not encoded
                assert got.skipped[switch][:3] == single.skipped[switch][:3]


def test_many_threads_share_a_clip_a_model_and_what_was_perceived() -> None:
    network, clip = model(), drive(5)
    perception = Perception(clip)
    wanted = {index: forecast_clip(clip, index, 1, [SOURCE], copy.deepcopy(network)) for index in (1, 2)}

    def task(number: int) -> Forecast:
        return forecast_frames(perception, network, 1 + number % 2, 1, [SOURCE])

    for number, got in enumerate(at_once(*(lambda number=number: task(number) for number in range(4)))):
        assert_same(got, wanted[1 + number % 2])


def test_a_threads_clock_is_its_own() -> None:
    network = model()
    begun, ended = threading.Event(), threading.Event()

    def elsewhere() -> None:
        begun.wait()
        run(network, views=2)
        ended.set()

    other = threading.Thread(target=elsewhere)
    other.start()
    with watching() as watch, count_skips() as tally:
        begun.set()
        ended.wait()
    other.join()
    assert watch.seconds == {} and tally.counts == {}


def test_a_clock_counts_stages_inside_stages_once_or_twice() -> None:
    """By default an outer stage has the inner one's time, of the wall and of the CPU; an exclusive clock's has not."""
    for exclusive in (False, True):
        clock = Clock(exclusive=exclusive)
        with clock.time("outer"), clock.time("inner"):
            sum(range(200_000))
        assert set(clock.seconds) == set(clock.cpu_seconds) == {"outer", "inner"}
        assert (clock.seconds["outer"] < clock.seconds["inner"]) is exclusive
        assert (clock.cpu_seconds["outer"] < clock.cpu_seconds["inner"]) is exclusive
