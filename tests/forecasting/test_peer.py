"""vestcl.forecasting.peer: images forecast recursively, and shown from other cameras by their geometry."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.forecasting import peer
from vestcl.forecasting.geometric import Perception, forecast_frames
from vestcl.forecasting.result import View
from vestcl.forecasting.views import parse_views
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

SIZE = 48, 160
SOURCE_VIEW = View("source", np.eye(4))


class Stand(VoxelFlowNetwork):
    """In place of a trained network: what ``rule`` makes of two frames."""

    def __init__(self, rule: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
        super().__init__(blocks=[(1, 4)])
        self.rule = rule

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        assert first.shape == second.shape and not any(side % 16 for side in first.shape[-2:])
        return self.rule(first, second)


def street(frames: int = 6) -> Clip:
    return street_clip(Street.generate(3), frames, *SIZE, samples=1)


def decibels(got: np.ndarray, wanted: np.ndarray) -> float:
    return float(metrics.psnr(*(torch.from_numpy(np.ascontiguousarray(image))[None] for image in (got, wanted))))


def test_each_forecast_frame_is_the_next_ones_input() -> None:
    """f(a, b) = (a + b) / 2 from 0 and 0.8: 0.4, 0.6, 0.5; sides that are no multiples of 16 come back as they were."""
    previous, current = (np.full((3, 21, 35), value, np.float32) for value in (0.0, 0.8))
    images = peer.forecast_images(Stand(lambda a, b: (a + b) / 2), previous, current, 3)
    for image, wanted in zip(images, (0.4, 0.6, 0.5), strict=True):
        assert image.shape == (3, 21, 35)
        np.testing.assert_allclose(image, wanted, rtol=1e-6)
    with pytest.raises(ValueError, match="`steps` must be 1 or more, got 0"):
        peer.forecast_images(Stand(lambda a, b: b), previous, current, 0)


def test_the_source_view_is_the_networks_image() -> None:
    clip = street()
    perception = Perception(clip)
    made = peer.forecast_frames(perception, Stand(lambda a, b: 1 - b), 2, 2, [SOURCE_VIEW])
    assert made.method == "DMVFN shape" and made.future_from_cur == [] and len(made.frames) == 2
    np.testing.assert_allclose(made.frames[0]["source"].image, 1 - clip[2].read_image(), atol=1e-6)
    np.testing.assert_allclose(made.frames[1]["source"].image, clip[2].read_image(), atol=1e-6)
    assert set(perception.seconds) == {"read"}, "geometry is for other cameras"
    assert made.frames[0]["source"].coverage.min() == 1


def test_the_right_view_shows_its_frames_by_geometry() -> None:
    """A network that knows the future: the right camera's truth is met better than by what the source camera sees."""
    clip = street()
    future = iter([clip[3].read_image(), clip[4].read_image()])
    network = Stand(lambda a, b: torch.from_numpy(np.array(next(future)))[None])
    made = peer.forecast_frames(Perception(clip), network, 2, 2, parse_views(["source", "right"], clip))
    assert list(made.frames[0]) == ["source", "right"]
    for step in (1, 2):
        right, image = clip[2 + step].right, clip[2 + step].read_image()
        assert right is not None
        truth, shown = right.read_image(), made.frames[step - 1]["right"].image
        assert decibels(shown, truth) > decibels(image, truth) + 1.5, step


def test_frames_after_t_are_not_looked_at() -> None:
    clip, views = street(), parse_views(["source", "right"], street())
    network = VoxelFlowNetwork(blocks=[(4, 8), (1, 4)]).eval()
    whole = peer.forecast_frames(Perception(clip), network, 2, 1, views)
    short = peer.forecast_frames(Perception(clip[:3]), network, 2, 1, views)
    for name in ("source", "right"):
        np.testing.assert_array_equal(whole.frames[0][name].image, short.frames[0][name].image)


def test_what_cannot_be_is_refused() -> None:
    perception, network = Perception(street(3)), Stand(lambda a, b: b)
    for index in (0, 3):
        with pytest.raises(ValueError, match=r"`index` must be 1 \.\.\. 2, a frame of street 3 with one before"):
            peer.forecast_frames(perception, network, index, 1, [SOURCE_VIEW])
    with pytest.raises(ValueError, match="`views` must be 1 or more, got none"):
        peer.forecast_frames(perception, network, 1, 1, [])


def test_it_asks_the_same_of_a_clip_as_the_geometric_forecast() -> None:
    """From a camera 0.3 m to the right: same names and shapes."""
    clip = street(4)
    views = parse_views(["0.3,0,0,name=shifted"], clip)
    made = peer.forecast_frames(Perception(clip), Stand(lambda a, b: b), 2, 1, views).frames[0]
    wanted = forecast_frames(Perception(clip), 2, 1, views).frames[0]
    assert {k: v.image.shape for k, v in made.items()} == {k: v.image.shape for k, v in wanted.items()}


def test_times_go_on_and_a_gap_is_noted() -> None:
    """Timestamps of a clip, at 10 Hz with a frame lost before t: the forecast frames' continue by its interval."""
    clip, seconds = street(4), (0.0, 0.1, 0.2, 0.4)
    samples = tuple(dataclasses.replace(s, timestamp=at) for s, at in zip(clip, seconds, strict=True))
    clip, network = dataclasses.replace(clip, samples=samples), Stand(lambda a, b: b)
    views = parse_views(["source", "right"], clip)
    even, gap = (peer.forecast_frames(Perception(clip), network, index, 1, views) for index in (2, 3))
    assert even.notes == () and even.frames[0]["right"].image.shape == (3, *SIZE)
    assert gap.notes == (
        "frames t-1 and t are 2 intervals apart, which DMVFN shape takes for one: steps may be too long",
    )
