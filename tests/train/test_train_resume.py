"""What of a configuration may change when a run continues, and what is said of the rest."""

import copy
import dataclasses
from typing import Any

import pytest
import torch
from checkpoint_states import SETTINGS, configured, state_of

from train.run import checkpoint
from train.run.resume import check_resume


def test_what_may_change_on_the_way() -> None:
    state = state_of(12)
    first, second = SETTINGS["stages"]
    for changes in (
        {},
        {"out": "elsewhere", "run": {"keep": 9, "threads": 1}, "data": {"train": ["streets"], "workers": 2}},
        {"stages": [first, {**second, "steps": 40}]},
        {"stages": [first, {**second, "steps": 2}]},
        {"stages": [first, second, {"name": "third", "steps": 5}]},
    ):
        check_resume(state, configured(**changes))
    check_resume(state_of(30), configured(stages=[first, {**second, "steps": 21}]))
    check_resume(state_of(5), configured(stages=[{**first, "steps": 6}, second]))


@pytest.mark.parametrize(
    ("step", "changes", "words"),
    [
        (12, {"seed": 1}, "`seed` was 0, is 1"),
        (12, {"model": "vest-s+joint"}, "`model` was 'vest-s', is 'vest-s+joint'"),
        (12, {"data": {"train": ["streets", "more"]}}, "`data.train.1` was None, is 'more'"),
        (12, {"stages": [{**SETTINGS["stages"][0], "steps": 11}, SETTINGS["stages"][1]]}, "`stages.0.steps` was 10"),
        (12, {"stages": SETTINGS["stages"][:1]}, "`stages.1.name` was 'second', is None"),
        (
            12,
            {"stages": [SETTINGS["stages"][0], {**SETTINGS["stages"][1], "batch": 8}]},
            "`stages.1.batch` was 4, is 8",
        ),
        (12, {"stages": [SETTINGS["stages"][0], {**SETTINGS["stages"][1], "steps": 1}]}, "`stages.1` must end at step"),
        (
            5,
            {"stages": [{**SETTINGS["stages"][0], "steps": 4}, SETTINGS["stages"][1]]},
            "`stages.0` must end at step 5",
        ),
    ],
)
def test_what_may_not(step: int, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - its words are what is tested
        check_resume(state_of(step), configured(**changes))
    assert words in str(caught.value)


def test_keys_that_came_later_have_their_defaults() -> None:
    """A checkpoint that was written before `loss.routing` and `init_encoder` continues."""
    state = state_of(12)
    settings = copy.deepcopy(dict(state.config))
    del settings["init_encoder"], settings["loss"]["routing"]
    check_resume(dataclasses.replace(state, config=settings), configured())
    changed = configured(loss={**SETTINGS["loss"], "routing": 0.5})
    with pytest.raises(ValueError, match=r"`loss\.routing` was 1\.0, is 0\.5"):
        check_resume(dataclasses.replace(state, config=settings), changed)


def test_all_that_differs_is_named() -> None:
    with pytest.raises(ValueError, match=r"(?s)checkpoint of step 3 .*`seed` was.*`optimiser.ema` was 0.999, is 0.5"):
        check_resume(state_of(3), configured(seed=4, optimiser={"ema": 0.5}))


def test_other_versions_are_warned_of() -> None:
    state = dataclasses.replace(state_of(3), versions={**checkpoint.package_versions(), "torch": "1.0"})
    with pytest.warns(UserWarning, match=f"other versions: torch 1.0 -> {torch.__version__.partition('+')[0]}"):
        check_resume(state, configured())
    check_resume(state_of(3), configured())
