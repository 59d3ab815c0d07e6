"""vestcl.forecasting.network.later_frames and what perceives a forecast frame."""

from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, TINY

from vestcl.constants import SKY_DEPTH
from vestcl.forecasting.network.later_frames import later_frames
from vestcl.io.labels import SKY
from vestcl.models.forecaster import perceive_estimated, perceive_forecast

CAR, ROAD = 13, 0


def depth(image: np.ndarray) -> np.ndarray:
    return np.full_like(image[:1], 9.0)


def classes(image: np.ndarray) -> np.ndarray:
    """Sky above, a car in the middle, else road."""
    ids = np.full((1, *image.shape[1:]), ROAD, np.uint8)
    ids[:, :4], ids[:, 12:20, 20:30] = SKY, CAR
    return ids


def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two frames as splatted: half of the depth unknown, and all taken for background."""
    image, metres = torch.rand(2, 3, 32, 48), torch.full((2, 1, 32, 48), 20.0)
    metres[..., 24:] = 0
    return image, metres, torch.ones_like(metres)


@pytest.mark.parametrize(
    ("config", "mode", "perceived", "estimators", "wanted"),
    [
        (TINY, None, None, {}, ("feedback", "splatted")),
        (SMALL, None, None, {"depth": depth}, ("compose", None)),
        (TINY, "compose", None, {"depth": depth}, ("compose", None)),
        (SMALL, "feedback", None, {"segmentation": classes}, ("feedback", "estimated")),
        (TINY, None, None, {"depth": depth}, ("feedback", "estimated")),
        (TINY, None, "splatted", {"depth": depth}, ("feedback", "splatted")),
        (TINY, None, "estimated", {"depth": depth, "segmentation": classes}, ("feedback", "estimated")),
    ],
)
def test_what_options_mean(config: Any, mode: Any, perceived: Any, estimators: Any, wanted: Any) -> None:
    chosen = later_frames(config, mode, perceived, **estimators)
    assert (chosen.mode, chosen.perceived) == wanted
    assert (chosen.perceive is not None) == (wanted[1] == "estimated")
    assert chosen.settings == {"mode": wanted[0], "perceive": wanted[1]}
    assert str(chosen) == (wanted[0] if wanted[1] is None else f"feedback, perceive {wanted[1]}")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((SMALL, None, "splatted"), "`perceive` must not be given with mode \"compose\", got 'splatted'"),
        ((TINY, None, "estimated"), '`perceive` "estimated" needs --depth-model'),
    ],
)
def test_what_does_not_go_together(arguments: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        later_frames(*arguments)


def test_depth_without_a_unit_is_not_for_forecast_frames() -> None:
    relative: Any = type("Relative", (), {"metric": False, "__call__": lambda self, image: depth(image)})()
    assert later_frames(TINY, None, None, relative).perceived == "splatted"
    with pytest.raises(ValueError, match=r'"estimated" needs --depth-model \(in metres\)'):
        later_frames(TINY, None, "estimated", relative)
    image, metres, mask = scene()
    perceive = later_frames(TINY, None, None, relative, classes).perceive
    assert perceive is not None and (perceive(image, metres, mask).depth[:, :, 4:] == 20).all()


def test_both_estimators_see_the_forecast_frame() -> None:
    image, metres, mask = scene()
    layers = perceive_estimated(depth, classes)(image, metres, mask)
    assert torch.equal(layers.image, image)
    assert (layers.mask[:, :, 12:20, 20:30] == 0).all() and layers.mask.sum() == 2 * (32 * 48 - 80)
    assert (layers.depth[:, :, :4] == SKY_DEPTH).all() and (layers.depth[:, :, 4:] == 9).all()
    assert (layers.background_depth[layers.mask == 0] > 9).all()


def test_one_estimator_leaves_the_other_to_the_splat() -> None:
    image, metres, mask = scene()
    mask[:, :, 8:12, 8:12], metres[:, :, :2] = 0, 0.98 * SKY_DEPTH
    by_depth, by_classes = perceive_estimated(depth)(image, metres, mask), perceive_estimated(None, classes)
    assert torch.equal(by_depth.mask, mask)
    assert (by_depth.depth[:, :, :2] == SKY_DEPTH).all() and (by_depth.depth[:, :, 2:, :20] == 9).all()
    seen, splatted = by_classes(image, metres, mask), perceive_forecast(image, metres, mask)
    assert torch.equal(seen.depth[:, :, 4:], splatted.depth[:, :, 4:]) and not torch.equal(seen.mask, splatted.mask)
    neither = perceive_estimated()(image, metres, mask)
    assert all(map(torch.equal, neither, splatted))


def test_wrong_answers_of_estimators_are_refused() -> None:
    with pytest.raises(ValueError, match=r"`depth`.*\[1, 32, 48\]"):
        perceive_estimated(lambda image: image)(*scene())
    with pytest.raises(ValueError, match=r"`segmentation` must give \[1, 32, 48\] uint8"):
        perceive_estimated(None, lambda image: image.astype(np.uint8))(*scene())
