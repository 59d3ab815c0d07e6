"""`vestcl bench depth`: one camera's depth against scans or a stereo pair: by motion, by a network, and combined."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import tyro
from rich.progress import track

from vestcl.bench.common.estimate import announced
from vestcl.bench.common.options import JsonOption
from vestcl.bench.common.results import console, plain, settings, write_json
from vestcl.bench.common.table import Measurement, Section, show_grid
from vestcl.cli.clip import load_estimators
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network.later_frames import DepthOf
from vestcl.scene.depth import DepthScores, depth_scores
from vestcl.scene.estimators import with_estimates

#: What is compared.
MOTION, NETWORK, COMBINED = "motion", "network", "combined"

#: Mean errors as tables show them, in the order of `DepthScores`.
_COLUMNS: Final = ("AbsRel", "median ratio", "AbsRel, scaled", "delta < 1.25")

#: Frames that motion looks back at.
_BEFORE: Final = 2


@dataclass(frozen=True)
class DepthBench(JsonOption):
    """Measure the depth of single cameras: by their motion, by a network, and by both combined.

    The truth is the clip's depth, else that of its stereo pair. Neither that nor labels are seen.
    """

    inputs: tyro.conf.Positional[tuple[str, ...]]
    """Clips with depth or a right camera, as `vestcl forecast` opens them."""
    depth_model: str | None = None
    """The network: FILE.onnx (described by FILE.json), a checkpoint's folder, or a name on huggingface.co."""
    every: int = 6
    """Take every such frame."""
    first: int = _BEFORE
    """The first frame, from 0."""
    last: int | None = None
    """The last; without it the clip's last."""
    crop: bool = False
    """Compare only the crop of Garg et al., as KITTI's tables do."""

    def __post_init__(self) -> None:
        if not self.inputs or self.every < 1 or self.first < 1:
            raise ValueError(
                "`inputs` must be one or more, --every and --first 1 or more, "
                f"got {len(self.inputs)} inputs, {self.every} and {self.first}"
            )


def main(config: DepthBench) -> None:
    """Measure, and print a table for each clip.

    Raises:
        ValueError: an input that is no clip, has no depth to compare with, or no such frame; as the network's loader.
    """
    network = load_estimators(config.depth_model, None).depth
    screen, results = console(), dict[str, Any]()
    for text in config.inputs:
        scores, rows = evaluate(open_sequence(text), network, config), list[Measurement]()
        for method, of_frames in scores.items():
            means = np.mean([found[: len(_COLUMNS)] for found in of_frames.values()], axis=0)
            rows.append(Measurement(method, "frames", str(len(of_frames))))
            rows += [Measurement(method, *cell, digits=".3f") for cell in zip(_COLUMNS, means, strict=True)]
        notes = ("means over the frames; AbsRel, scaled: of the depth over its median ratio",)
        show_grid(Section(f"{text}: depth by", rows, notes).grid(), screen)
        results[text] = {
            method: {frame: found._asdict() for frame, found in of_frames.items()}
            for method, of_frames in scores.items()
        }
    if config.json is not None:
        write_json(config.json, plain({"config": settings(config), "scores": results}))


def evaluate(clip: Clip, network: DepthOf | None, config: DepthBench) -> dict[str, dict[int, DepthScores]]:
    """Errors by method and frame.

    Args:
        clip: with depth or a right camera.
        network: [3, H, W] RGB in [0, 1] -> [1, H, W] m; None leaves out what needs one.
        config: frames and crop.

    Raises:
        ValueError: no depth to compare with, or no such frame.
    """
    if clip[0].depth is None and clip[0].right is None:
        raise ValueError(f"{clip.name}: must have depth or a right camera to compare with")
    last = len(clip) - 1 if config.last is None else min(config.last, len(clip) - 1)
    frames = range(config.first, last + 1, config.every)
    if not frames:
        raise ValueError(f"{clip.name}: must have a frame from `first` to `last`, got {config.first} to {last}")
    truth = Perception(replace(clip, samples=tuple(replace(sample, labels=None) for sample in clip)))
    bare = replace(clip, samples=tuple(replace(s, depth=None, labels=None, right=None) for s in clip))
    methods = {MOTION: Perception(bare)}
    if network is not None:
        methods[COMBINED] = Perception(with_estimates(bare, depth=network))
    names = [MOTION] if network is None else [MOTION, NETWORK, COMBINED]
    scores: dict[str, dict[int, DepthScores]] = {name: {} for name in names}
    counted = announced(frames, console(), "frames")
    for index in track(counted, clip.name, len(frames), transient=True):
        # Scans are compared where they have returns, not where they were densified.
        true = clip[index].read_depth() if clip[index].depth is not None else truth.raw_depth(index)
        found = {name: perception.raw_depth(index) for name, perception in methods.items()}
        if network is not None:
            found[NETWORK] = network(clip[index].read_image())
        for name, depth in found.items():
            scores[name][index] = depth_scores(depth, true, crop=config.crop)
    return scores
