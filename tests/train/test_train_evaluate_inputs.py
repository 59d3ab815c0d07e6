"""train.evaluation.inputs: where depth comes from, and what no forecast may see."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluated_inputs import known_of
from forecaster_scenes import TINY, stir

from train.evaluation.inputs import (
    PAIR,
    Preprocessing,
    check_stereo,
    depths,
    given,
    label_of,
    plain,
    sentences,
)
from train.evaluation.protocols import NOW, NOW_BORDER, PROTOCOLS, Name
from train.evaluation.setup import Setup
from train.evaluation.windows import forecast, inputs_of, perceptions_of, prepared, presenters, views_of, window
from vestcl.cli.clip import Estimators
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, RightCamera
from vestcl.data.sources import DisparityFile, ImageArray
from vestcl.evaluation import metrics
from vestcl.evaluation.border import blacken_border
from vestcl.evaluation.scores import GEOMETRIC, SOURCE, Truth
from vestcl.forecasting.result import View
from vestcl.forecasting.views import parse_view
from vestcl.models.forecaster import Forecaster
from vestcl.scene.inputs import Inputs

SIZE = 48, 160


@pytest.fixture(scope="module")
def clip() -> Clip:
    """With depth, and a right camera."""
    return street_clip(Street.generate(3), 5, *SIZE, samples=1)


def without_depth(clip: Clip) -> Clip:
    return dataclasses.replace(clip, samples=tuple(dataclasses.replace(sample, depth=None) for sample in clip))


def with_other_right(clip: Clip) -> Clip:
    """The right camera sees noise."""
    noise = np.random.default_rng(0).random((3, *SIZE), np.float32)
    samples = []
    for sample in clip:
        assert sample.right is not None
        right = RightCamera(ImageArray(noise), sample.right.K, sample.right.right_from_left)
        samples.append(dataclasses.replace(sample, right=right))
    return dataclasses.replace(clip, samples=tuple(samples))


def setup(name: Name, stereo: bool = False) -> Setup:
    return Setup(PROTOCOLS[name], SIZE, 1, {}, stereo=stereo)


@pytest.mark.parametrize(
    ("name", "of_clip", "stereo", "without"),
    [
        ("kitti-space", ("clip",), None, ("motion",)),
        ("kitti-space-val", ("clip",), None, ("motion",)),
        ("kitti-space-time", ("clip",), ("clip", "pair"), ("motion", "pair")),
        ("street", ("clip",), ("clip", "pair"), ("motion", "pair")),
        ("kitti-prediction", ("clip",), ("pair",), ("pair",)),
    ],
)
def test_where_depth_comes_from(
    clip: Clip, name: Name, of_clip: tuple[str], stereo: tuple[str] | None, without: tuple[str]
) -> None:
    """Of a clip with depth, of the same with --stereo, and of one without depth."""
    assert depths(clip, PROTOCOLS[name], False) == of_clip
    assert depths(without_depth(clip), PROTOCOLS[name], False) == without
    if stereo is None:
        with pytest.raises(
            ValueError, match="`--stereo` must not be used here: depth would be matched against the righ"
        ):
            check_stereo(PROTOCOLS[name], True)
    else:
        check_stereo(PROTOCOLS[name], True)
        assert depths(clip, PROTOCOLS[name], True) == stereo
    mono = given(without_depth(clip), "motion")
    assert depths(mono, PROTOCOLS[name], True) == ("motion",)


def test_what_is_given(clip: Clip) -> None:
    assert given(clip, "clip") is clip
    assert all(sample.depth is None and sample.right is not None for sample in given(clip, "pair"))
    assert all(sample.depth is None and sample.right is None for sample in given(clip, "motion"))
    assert known_of(clip, ("clip", "pair")) == (
        'Depth is from the street itself, true and from the stereo pair at t-1 and t (rows ending in "stereo pair"), '
        "masks are from labels."
    )


def test_labels() -> None:
    assert (plain(GEOMETRIC + PAIR), label_of(GEOMETRIC + PAIR)) == (GEOMETRIC, PAIR)
    assert (plain("vest-s"), label_of("vest-s")) == ("vest-s", "")


@pytest.mark.parametrize("name", ["kitti-space", "kitti-space-val"])
def test_the_answer_is_not_seen(clip: Clip, name: Name) -> None:
    """The right camera's image at t is drawn without it: whatever that camera sees, the image is the same."""
    shown, made = [], []
    for seen in (without_depth(clip), with_other_right(without_depth(clip))):
        (perception,) = perceptions_of(seen, setup(name)).values()
        view = dataclasses.replace(parse_view("right", seen), name=NOW)
        shown.append(presenters(setup(name))[GEOMETRIC](perception, 2, [view])[NOW].image)
        source = views_of(seen, setup(name))
        made.append(forecast(perception, 2, source, setup(name))[GEOMETRIC].forecast.frames[0][SOURCE].image)
    assert np.array_equal(*shown) and np.array_equal(*made)


def test_frames_without_depth_do_not_see_the_answer(clip: Clip) -> None:
    """Scans that are missing for some frames: depth there is from motion, whatever the right camera sees."""
    some = [dataclasses.replace(s, depth=s.depth if i in (0, 3) else None) for i, s in enumerate(clip)]
    partly, depths_seen = dataclasses.replace(clip, samples=tuple(some)), []
    for seen in (partly, with_other_right(partly)):
        assert depths(seen, PROTOCOLS["kitti-space"], False) == ("clip",)
        ((ending, perception),) = perceptions_of(seen, setup("kitti-space")).items()
        depths_seen.append(perception.raw_depth(2))
        assert ending == "" and np.array_equal(perception.raw_depth(3), clip[3].read_depth())
    assert np.array_equal(*depths_seen)
    late = [dataclasses.replace(s, depth=s.depth if i == 3 else None) for i, s in enumerate(clip)]
    assert depths(dataclasses.replace(clip, samples=tuple(late)), PROTOCOLS["kitti-space"], False) == ("clip",)


def test_disparity_files_are_of_the_pair(clip: Clip) -> None:
    """Cityscapes' disparity is matched against the right image of its frame: rows say so, and where that is judged,
    or next to it, depth is from motion."""
    matched = DisparityFile(Path("disparity.png"), 0.2, 2262.5)
    seen = dataclasses.replace(clip, samples=tuple(dataclasses.replace(s, depth=matched) for s in clip))
    for name, wanted in {
        "cityscapes-prediction": ("clip",),
        "kitti-space": ("motion",),
        "kitti-space-time": ("motion", "clip"),
    }.items():
        assert depths(seen, PROTOCOLS[name], False) == wanted  # type: ignore[index]
    assert depths(seen, PROTOCOLS["kitti-space-time"], True) == ("motion", "pair")
    assert list(perceptions_of(seen, setup("cityscapes-prediction"))) == [PAIR]
    assert list(perceptions_of(seen, setup("kitti-space-time"))) == ["", PAIR]
    both = inputs_of(seen, setup("kitti-space-time"))
    words = [given.depth for _, given in both.values()]
    assert words == ["motion", "disparity files, matched in the stereo pair"]


def test_classes_make_the_mask_of_both_frames(clip: Clip) -> None:
    """With a mask model the paper's M, of parked cars too; of a clip that labels one frame, as Cityscapes does."""

    def classes(image: np.ndarray) -> np.ndarray:
        ids = np.zeros((1, *image.shape[1:]), np.uint8)
        ids[..., :40] = 13
        return ids

    how = Preprocessing(mask_model="a/b", estimators=Estimators(None, classes))
    some = [dataclasses.replace(s, labels=s.labels if i == 2 else None) for i, s in enumerate(clip)]
    seen, wanted = (
        dataclasses.replace(clip, samples=tuple(some)),
        dataclasses.replace(setup("street"), preprocessing=how),
    )
    (perception,) = perceptions_of(prepared(seen, wanted), wanted).values()
    for index in (1, 2):
        assert (~perception.mask(index)[..., :40]).all() and perception.mask(index)[..., 40:].all()
    (given_words,) = (words for _, words in inputs_of(prepared(seen, wanted), wanted).values())
    assert given_words.masks == "the classes of a/b"


def test_sentences_name_clips_that_differ() -> None:
    one = Inputs("laser scans, densified", "motion", "optical flow and depth", "regions")
    other = Inputs("the stereo pair at t-1 and t", "motion", "optical flow and depth", "regions", stereo=True)
    assert sentences({"a": {"": one}, "b": {"": one}}) == (
        "Depth is from laser scans, densified, masks are from motion.",
        "Camera motion up to t is from optical flow and depth, inpainting is by regions.",
    )
    first, second = sentences({"a": {"": one}, "b": {PAIR: other}, "c": {"": one}})
    assert first.startswith("a, c: Depth is from laser scans") and first.endswith("inpainting is by regions.")
    assert second.startswith('b: Depth is from the stereo pair at t-1 and t (rows ending in "stereo pair"), masks')


def test_the_pair_has_rows_of_its_own(clip: Clip) -> None:
    """With the right camera's future as the answer: monocular rows do not change with what that camera sees at t."""
    model = stir(Forecaster(TINY)).eval()
    wanted = Setup(PROTOCOLS["kitti-space-time"], SIZE, 1, {"tiny": model})
    bare = without_depth(clip)
    scores = []
    for seen in (bare, with_other_right(bare)):
        records = window(perceptions_of(seen, wanted), Truth(bare, SIZE), 2, wanted)
        scores.append({record.method: record.scores["psnr"] for record in records if record.view == "right"})
    assert {GEOMETRIC, "tiny", GEOMETRIC + PAIR, "tiny" + PAIR} < set(scores[0])
    for method in (GEOMETRIC, "tiny"):
        assert scores[0][method] == scores[1][method]
        assert scores[0][method + PAIR] != scores[1][method + PAIR]


# ---------------------------------------------------------------- the view at t, as VEST-MPI scores it


def published_ssim(one: torch.Tensor, other: torch.Tensor) -> float:
    """SSIM of two images [1, 3, H, W]: 11 x 11 windows around every pixel, zeros beyond the image, mean over all."""
    line = torch.exp(-((torch.arange(11.0) - 5) ** 2) / (2 * 1.5**2))
    kernel = torch.outer(line, line)
    kernel = (kernel / kernel.sum()).expand(3, 1, 11, 11)

    def mean(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image, kernel, padding=5, groups=3)

    a, b = mean(one), mean(other)
    aa, bb, ab = mean(one * one) - a * a, mean(other * other) - b * b, mean(one * other) - a * b
    c, d = 0.01**2, 0.03**2
    return float((((2 * a * b + c) * (2 * ab + d)) / ((a * a + b * b + c) * (aa + bb + d))).mean())


def test_the_border_is_black_on_both_sides() -> None:
    image = torch.rand(2, 3, 40, 60)
    inner = blacken_border(image, 0.05)
    assert (inner[..., :2, :] == 0).all() and (inner[..., -2:, :] == 0).all()
    assert (inner[..., :3] == 0).all() and (inner[..., -3:] == 0).all()
    assert torch.equal(inner[..., 2:-2, 3:-3], image[..., 2:-2, 3:-3])
    assert torch.equal(blacken_border(image, 0.0), image)
    for wrong in (-0.1, 0.5):
        with pytest.raises(ValueError, match=r"`share` must be 0 or more and below 0\.5"):
            blacken_border(image, wrong)


def test_the_present_is_scored_as_vest_mpi_does(clip: Clip) -> None:
    wanted = setup("kitti-space")
    records = window(perceptions_of(clip, wanted), Truth(clip, SIZE), 2, wanted)
    (found,) = [record for record in records if (record.view, record.method) == (NOW, GEOMETRIC)]
    view = dataclasses.replace(parse_view("right", clip), name=NOW)
    (perception,) = perceptions_of(clip, wanted).values()
    picture = presenters(wanted)[GEOMETRIC](perception, 2, [view])[NOW].image
    camera = clip[2].right
    assert camera is not None and NOW_BORDER == 0.05
    inside = torch.zeros(1, 1, *SIZE)
    inside[..., 2:-2, 8:-8] = 1  # 5 % of 48 and of 160
    one, other = (metrics.quantise(torch.from_numpy(p)[None]) * inside for p in (picture, camera.read_image()))
    assert found.scores["ssim"] == [pytest.approx(published_ssim(one, other), abs=1e-5)]
    mse = float((one - other).square().mean())
    assert found.scores["psnr"] == [pytest.approx(-10 * np.log10(mse), abs=1e-3)]
    whole = float(metrics.ssim(*(metrics.quantise(torch.from_numpy(p)[None]) for p in (picture, camera.read_image()))))
    assert abs(found.scores["ssim"][0] - whole) > 0.001  # the convention matters


def test_the_future_is_scored_whole(clip: Clip) -> None:
    wanted = setup("kitti-space")
    records = window(perceptions_of(clip, wanted), Truth(clip, SIZE), 2, wanted)
    (found,) = [record for record in records if (record.view, record.method) == (SOURCE, GEOMETRIC)]
    (perception,) = perceptions_of(clip, wanted).values()
    made = forecast(perception, 2, [View(SOURCE, np.eye(4))], wanted)[GEOMETRIC].forecast.frames[0][SOURCE].image
    pair = (metrics.quantise(torch.from_numpy(np.ascontiguousarray(p))[None]) for p in (made, clip[3].read_image()))
    assert found.scores["ssim"] == [pytest.approx(float(metrics.ssim(*pair)), rel=1e-5)]
