"""Whether a run may resume from a checkpoint that was written under another configuration."""

import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, Final

from train.run.checkpoint import TrainingState, package_versions
from train.settings.config import Config, from_dict, to_dict

#: Keys that may change on the way: none of them is a part of what was learnt so far.
_FREE: Final = re.compile(r"((run|out|data\.workers|stages\.\d+\.data\.workers)(\.|$))")

_OF_STAGE: Final = re.compile(r"stages\.(\d+)\.(.*)")


def check_resume(state: TrainingState, config: Config) -> None:
    """Whether ``config`` continues with what ``state`` began. Other versions of packages are warned of.

    ``run``, ``out`` and the number of workers may change. So may the steps of stages that are not over and of the last
    one, and stages may be added at the end.

    Args:
        state: the checkpoint.
        config: of the run to resume.

    Raises:
        ValueError: something else differs; the message says which keys, what they were and what they are. Or what is
            done of a stage is more than it is to have.
    """
    then, now = dict(_flat(_completed(state.config))), dict(_flat(to_dict(config)))
    ends = _ends(state.config)
    changed = [
        f"  `{key}` was {then.get(key)!r}, is {now.get(key)!r}"
        for key in then | now
        if then.get(key) != now.get(key) and not _may_change(key, state.step, ends)
    ]
    if changed:
        raise ValueError("\n".join([f"the checkpoint of step {state.step} is of another configuration:", *changed]))
    begun = sum(end <= state.step for end in ends[:-1])
    if state.step > (total := sum(stage.steps for stage in config.stages[: begun + 1])):
        raise ValueError(f"`stages.{begun}` must end at step {state.step} or later, which is done, got {total}")
    versions = package_versions()
    if other := [f"{name} {old} -> {versions.get(name)}" for name, old in state.versions.items()
                 if versions.get(name) != old]:  # fmt: skip
        warnings.warn(f"the checkpoint was written with other versions: {', '.join(other)}", stacklevel=2)


def _completed(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """With the defaults of keys that came after the checkpoint was written; as it is where it is not valid any more."""
    try:
        return to_dict(from_dict(settings))
    except ValueError:
        return settings


def _may_change(key: str, step: int, ends: list[int]) -> bool:
    """Whether the leaf ``key`` may differ after ``step`` of stages that were to end at ``ends``."""
    if _FREE.match(key):
        return True
    if not (of_stage := _OF_STAGE.fullmatch(key)):
        return False
    number = int(of_stage[1])
    is_added, is_last = number >= len(ends), number == len(ends) - 1
    return is_added or (of_stage[2] == "steps" and (is_last or step < ends[number]))


def _ends(config: Mapping[str, Any]) -> list[int]:
    """The step that each stage ends at."""
    steps = [stage["steps"] for stage in config["stages"]]
    return [sum(steps[: number + 1]) for number in range(len(steps))]


def _flat(value: Any, above: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every leaf; an empty list or mapping is one."""
    if not value or not isinstance(value, (Mapping, list)):
        yield above.removesuffix("."), value
        return
    for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
        yield from _flat(inner, f"{above}{key}.")
