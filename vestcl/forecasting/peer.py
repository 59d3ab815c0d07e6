"""A learned 2D peer: a DMVFN-shaped network forecasts images, and geometry shows them from other cameras.

The paper's baseline "DMVFN -> 3D Photo", with this project's own layers, inpainting and splatting.
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from vestcl.data.sample import Clip, Sample
from vestcl.forecasting.geometric import Perception, show_frame
from vestcl.forecasting.geometric.forecast import at_recorded_size, working_frames, working_view
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.models.networks.voxel_flow import MULTIPLE, VoxelFlowNetwork
from vestcl.times import is_same

#: The name of this method in tables and files.
METHOD: Final = "DMVFN shape"

#: How, for notes below tables.
ABOUT: Final = (
    "images by 2D voxel flow from two frames, later ones recursively; the right view shows its forecast frames by "
    "geometry, with the geometric forecast's depth."
)

#: The source camera, as the geometric forecast is asked for its depth.
_SOURCE: Final = "source"


def forecast_images(
    network: VoxelFlowNetwork, previous: NDArray[np.float32], current: NDArray[np.float32], steps: int
) -> list[NDArray[np.float32]]:
    """I_(t+1) = f(I_(t-1), I_t), I_(t+2) = f(I_t, I_(t+1)), ...: each forecast frame is the next one's input.

    Args:
        network: trained.
        previous: [3, H, W] RGB in [0, 1], at t-1.
        current: [3, H, W], at t.
        steps: frames to forecast, 1 or more.

    Returns:
        [3, H, W] in [0, 1] a step. Sides that are not multiples of 16 px are repeated at their end, and cut again.

    Raises:
        ValueError: no steps, or images of different or other shapes.
    """
    if steps < 1:
        raise ValueError(f"`steps` must be 1 or more, got {steps}")
    height, width = current.shape[-2:]
    first, second = (_padded(image) for image in (previous, current))
    images = []
    with torch.inference_mode():
        for _ in range(steps):
            first, second = second, network(first, second)
            images.append(np.ascontiguousarray(second[0, :, :height, :width].numpy()))
    return images


def forecast_frames(
    perception: Perception, network: VoxelFlowNetwork, index: int, steps: int, views: Sequence[View]
) -> Forecast:
    """The frames after ``index``: from the source camera as the network forecasts them, from others by their geometry.

    To be seen from another camera, frame t+k gets the depth that the geometric forecast has at t+k; from there it is a
    frame as any other (masks from motion, inpainted layers, points splatted:
    `vestcl.forecasting.geometric.show_frame`).

    Args:
        perception: of the clip; other cameras need its depth and motion, the source camera only its images.
        network: trained.
        index: the current frame t, 1 or more.
        steps: frames to forecast.
        views: cameras to show each from.

    Returns:
        The forecast. It knows no motion: ``future_from_cur`` is empty. From the source camera depth is unknown (0) and
        coverage 1.

    Raises:
        ValueError: no such frame or none before it, no steps or views, or a clip without a source of depth.
    """
    clip = perception.clip
    if not 1 <= index < len(clip):
        raise ValueError(f"`index` must be 1 ... {len(clip) - 1}, a frame of {clip.name} with one before, got {index}")
    if not views:
        raise ValueError("`views` must be 1 or more, got none")
    start = time.perf_counter()
    images = forecast_images(network, perception.image(index - 1), perception.image(index), steps)
    seconds = {"network": time.perf_counter() - start}
    views = [working_view(perception, view) for view in views]
    others = [view for view in views if not is_source(view, clip[index])]
    shown: list[dict[str, Rendered]] = [{}] * steps
    if others:
        start = time.perf_counter()
        shown = _shown(perception, index, images, others)
        seconds["geometry"] = time.perf_counter() - start
    frames = [{view.name: shown[k].get(view.name) or _flat(images[k]) for view in views} for k in range(steps)]
    return at_recorded_size(Forecast(METHOD, [], frames, seconds, notes=_gap_notes(clip, index)), perception)


def is_source(view: View, sample: Sample) -> bool:
    """Whether ``view`` is the source camera itself, which sees the network's images as they are."""
    return np.array_equal(view.tgt_from_next, np.eye(4)) and (view.K is None or np.allclose(view.K, sample.K))


def _gap_notes(clip: Clip, index: int) -> tuple[str, ...]:
    elapsed = clip.elapsed(index)
    if is_same(elapsed, 1.0):
        return ()
    return (f"frames t-1 and t are {elapsed:.3g} intervals apart, which {METHOD} takes for one: steps may be too long",)


def _shown(
    perception: Perception, index: int, images: Sequence[NDArray[np.float32]], views: Sequence[View]
) -> list[dict[str, Rendered]]:
    """Each image from ``views``, with the geometric forecast's depth, after the two frames that were really seen."""
    clip, source = perception.clip, View(_SOURCE, np.eye(4))
    geometric = working_frames(perception, index, len(images), [source])
    depths = [frame[_SOURCE].depth for frame in geometric.frames]
    pairs = zip(images, depths, strict=True)
    forecast = [_sample(clip, index, step, *pair) for step, pair in enumerate(pairs, start=1)]
    seen = Perception(Clip(clip.name, METHOD, (clip[index - 1], clip[index], *forecast)), inpaint=perception.inpaint)
    return [show_frame(seen, step, views) for step in range(2, 2 + len(forecast))]


def _sample(clip: Clip, index: int, step: int, image: NDArray[np.float32], depth: NDArray[np.float32]) -> Sample:
    """Frame t+k as a reader would give it; ``step`` k is an interval of the clip."""
    current, interval = clip[index], clip.interval
    later = None if current.timestamp is None or interval is None else current.timestamp + step * interval
    sample = Sample.from_arrays(f"{current.name}+{step}", image, current.K, depth=depth, timestamp=later)
    return dataclasses.replace(sample, ego_vehicle=current.ego_vehicle)


def _padded(image: NDArray[np.float32]) -> torch.Tensor:
    """[1, 3, H', W'] with sides of multiples of 16 px."""
    below, right = (-side % MULTIPLE for side in image.shape[-2:])
    return functional.pad(torch.from_numpy(np.array(image))[None], (0, right, 0, below), mode="replicate")


def _flat(image: NDArray[np.float32]) -> Rendered:
    """An image of which nothing else is known."""
    plane = np.zeros_like(image[:1])
    return Rendered(image, plane, plane + 1, np.zeros_like(image))
