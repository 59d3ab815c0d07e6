"""Depth and classes by transformers' networks: against transformers' own way, and what is refused."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from tiny_networks import (
    HALVES,
    ROOM,
    STREET,
    depth_anything,
    mask2former,
    noise_image,
    processor,
    segformer,
    transformers,
    zoedepth,
)

from vestcl.io.labels import background
from vestcl.scene.estimators import DepthEstimator, SegmentationEstimator
from vestcl.scene.estimators._preparation import Preparation
from vestcl.scene.estimators.depth import NEAREST
from vestcl.scene.estimators.segmentation import CLASSES


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoints")
    zoedepth(folder / "votes-nyu", [ROOM, STREET], vote=0)
    zoedepth(folder / "votes-kitti", [ROOM, STREET], vote=1)
    zoedepth(folder / "one-head", [STREET])
    depth_anything(folder / "depth-anything")
    segformer(folder / "segformer", CLASSES)
    mask2former(folder / "mask2former", CLASSES)
    return folder


DEPTH = ("votes-nyu", "one-head", "depth-anything")
CLASS = ("segformer", "mask2former")


@pytest.mark.parametrize("name", DEPTH)
@pytest.mark.parametrize("size", [(48, 120), (37, 41), (5, 90)])
def test_depth_is_metres_at_the_images_size(checkpoints: Path, name: str, size: tuple[int, int]) -> None:
    estimator = DepthEstimator.load(checkpoints / name)
    depth = estimator(noise_image(*size))
    assert depth.shape == (1, *size) and depth.dtype == np.float32
    assert np.isfinite(depth).all() and depth.min() >= NEAREST
    assert np.array_equal(depth, estimator(noise_image(*size)))
    assert not np.allclose(depth, estimator(noise_image(*size, seed=1)), rtol=1e-3)


@pytest.mark.parametrize("name", DEPTH)
def test_a_batch_gives_what_each_image_gives(checkpoints: Path, name: str) -> None:
    estimator = DepthEstimator.load(checkpoints / name)
    images = np.stack([noise_image(seed=seed) for seed in range(3)])
    single = np.stack([estimator(image) for image in images])
    np.testing.assert_allclose(estimator.batch(images), single, rtol=1e-4)


def test_zoedepth_measures_streets_whatever_its_classifier_votes(checkpoints: Path) -> None:
    """Both have the same weights but for the vote; the room's head would answer something else."""
    room, street = (DepthEstimator.load(checkpoints / f"votes-{name}") for name in ("nyu", "kitti"))
    forced = room(noise_image())
    assert np.array_equal(forced, street(noise_image()))
    own = transformers().ZoeDepthForDepthEstimation.from_pretrained(checkpoints / "votes-nyu").eval()
    room.model.metric_head.mlp_classifier = own.metric_head.mlp_classifier
    unforced = DepthEstimator(room.model, room.preparation, None, room.flip, "cpu")
    assert not np.allclose(forced, unforced(noise_image()), rtol=0.01)
    with pytest.raises(RuntimeError, match="was not counted"):
        room(noise_image())


def test_zoedepth_averages_with_the_mirrored_image(checkpoints: Path) -> None:
    image = noise_image()
    both = DepthEstimator.load(checkpoints / "one-head")
    np.testing.assert_allclose(both(image[..., ::-1]), both(image)[..., ::-1], rtol=1e-4)
    one = DepthEstimator.load(checkpoints / "one-head", flip=False)
    assert not np.allclose(one(image[..., ::-1]), one(image)[..., ::-1], rtol=1e-3)


@pytest.mark.parametrize("zoe", [True, False])
def test_depth_lies_where_the_image_has_it(zoe: bool) -> None:
    """A network that answers with what it sees: padding, resize, mirroring and their undoing move nothing."""
    settings = {"size": {"height": 64, "width": 64}, "keep_aspect_ratio": True, "resample": 2, **HALVES}
    preparation = Preparation.read("", {**settings, "ensure_multiple_of": 32}, zoe=zoe, size=None)
    model = lambda pixel_values: SimpleNamespace(predicted_depth=pixel_values[:, 0] * 20 + 40)  # noqa: E731
    image = noise_image(60, 200)
    depth = DepthEstimator(model, preparation, None, zoe, "cpu")(image)
    inside = np.s_[:, 3:-3, 3:-3]
    wanted = (20 + 40 * image[:1])[inside]
    step = np.abs(np.diff(wanted)).max() + np.abs(np.diff(wanted, axis=1)).max()
    assert np.abs(depth[inside] - wanted).max() < step  # less than a pixel of shift


def test_depth_anything_agrees_with_transformers(checkpoints: Path) -> None:
    folder, image = checkpoints / "depth-anything", noise_image()
    estimator = DepthEstimator.load(folder)
    model = transformers().DepthAnythingForDepthEstimation.from_pretrained(folder).eval()
    theirs = processor("DPTImageProcessor").from_pretrained(folder)
    with torch.inference_mode():
        output = model(estimator.preparation(torch.from_numpy(image)[None]))
    wanted = theirs.post_process_depth_estimation(output, [image.shape[1:]])[0]["predicted_depth"].numpy()
    np.testing.assert_allclose(estimator(image)[0], wanted.clip(NEAREST), rtol=1e-5)


@pytest.mark.parametrize(("name", "kind"), [("segformer", "Segformer"), ("mask2former", "Mask2Former")])
def test_classes_agree_with_transformers(checkpoints: Path, name: str, kind: str) -> None:
    folder, image = checkpoints / name, noise_image()
    estimator = SegmentationEstimator.load(folder)
    networks = {"segformer": "SegformerForSemanticSegmentation", "mask2former": "Mask2FormerForUniversalSegmentation"}
    model = getattr(transformers(), networks[name]).from_pretrained(folder).eval()
    theirs = processor(f"{kind}ImageProcessor").from_pretrained(folder)
    with torch.inference_mode():
        output = model(estimator.preparation(torch.from_numpy(image)[None]))
    wanted = theirs.post_process_semantic_segmentation(output, [image.shape[1:]])[0].numpy()
    assert len(np.unique(wanted)) > 1
    np.testing.assert_array_equal(estimator(image)[0], wanted)


@pytest.mark.parametrize("name", CLASS)
def test_classes_are_train_ids_at_the_images_size(checkpoints: Path, name: str) -> None:
    estimator = SegmentationEstimator.load(checkpoints / name)
    images = np.stack([noise_image(37, 41, seed) for seed in range(2)])
    ids = estimator.batch(images)
    assert ids.shape == (2, 1, 37, 41) and ids.dtype == np.uint8 and ids.max() < len(CLASSES)
    assert np.array_equal(ids[0], estimator(images[0])) and np.array_equal(ids[1], estimator(images[1]))
    assert background(ids).shape == ids.shape


def test_a_size_from_the_user(checkpoints: Path) -> None:
    assert DepthEstimator.load(checkpoints / "one-head", size=(100, 300)).preparation.network_size(375, 1242) == (
        96,
        288,
    )
    assert SegmentationEstimator.load(checkpoints / "segformer", size=(64, 200))(noise_image()).shape == (1, 48, 120)
    with pytest.raises(ValueError, match=r"`size` must be \(height, width\) in px, got \(0, 3\)"):
        SegmentationEstimator.load(checkpoints / "segformer", size=(0, 3))


REFUSED: dict[str, tuple[Callable[[Path], object], Any, str]] = {
    "relative": (lambda folder: depth_anything(folder, "relative", 1), DepthEstimator, "metric depth, got relative"),
    "room": (lambda folder: depth_anything(folder, farthest=20), DepthEstimator, "made for streets.*up to 20 m"),
    "zoe room": (lambda folder: zoedepth(folder, [ROOM]), DepthEstimator, "made for streets.*up to 10 m"),
    "no kitti": (
        lambda folder: zoedepth(folder, [ROOM, {**STREET, "name": "ddad"}]), DepthEstimator,
        "must have a head named kitti, got nyu, ddad",
    ),
    "classes": (lambda folder: segformer(folder, CLASSES), DepthEstimator, "one of zoedepth, depth_anything, got segf"),
    "depth": (depth_anything, SegmentationEstimator, "one of segformer, mask2former, got depth_anything"),
    "order": (
        lambda folder: segformer(folder, (*CLASSES[:17], "bicycle", "motorcycle")), SegmentationEstimator,
        "Cityscapes' 19 classes in order, got bicycle as class 17, which is motorcycle",
    ),
    "ADE20K": (
        lambda folder: segformer(folder, ("wall", "building", "sky", "floor")), SegmentationEstimator,
        r"19 classes in order, got 4 classes \(wall, building, sky \.\.\.\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_networks_that_do_something_else_are_refused(tmp_path: Path, case: str) -> None:
    make, estimator, message = REFUSED[case]
    make(tmp_path)
    with pytest.raises(ValueError, match=message):
        estimator.load(tmp_path)


def drop_preparation(folder: Path) -> None:
    (folder / "preprocessor_config.json").unlink()


def change_preparation(**changes: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        file = folder / "preprocessor_config.json"
        known = {**json.loads(file.read_text()), **changes}
        file.write_text(json.dumps({key: value for key, value in known.items() if value is not None}))

    return change


def drop_a_weight(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    del weights["decode_head.classifier.weight"]
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


def spoil_a_weight(number: float) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        weights = load_file(folder / "model.safetensors")
        weights["decode_head.classifier.weight"][3] = number
        save_file(weights, folder / "model.safetensors", {"format": "pt"})

    return spoil


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (drop_preparation, "preprocessor_config.json"),
        (
            lambda folder: (folder / "preprocessor_config.json").write_text("{"),
            "not a checkpoint that transformers can",
        ),
        (lambda folder: (folder / "preprocessor_config.json").write_text("[]"), "must be an object, got list"),
        (change_preparation(image_mean=None), "preprocessor_config.json must have image_mean"),
        (change_preparation(resample=1), r"resample must be 2 \(bilinear\) or 3 \(bicubic\), got 1"),
        (change_preparation(size={"height": 5}), "size must have height and width"),
        (lambda folder: (folder / "config.json").write_text("{}"), "not a checkpoint that transformers can load"),
        (lambda folder: (folder / "model.safetensors").unlink(), "not a checkpoint that transformers can load"),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"12345"), "not a checkpoint that transformers can"),
        (drop_a_weight, "must have every parameter, got none for decode_head.classifier.weight"),
        (spoil_a_weight(np.nan), "weights must be finite, got NaN or infinity in decode_head.classifier.weight"),
        (spoil_a_weight(-np.inf), "weights must be finite, got NaN or infinity in decode_head.classifier.weight"),
    ],
)
def test_damaged_checkpoints(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(segformer(tmp_path, CLASSES))
    with pytest.raises(ValueError, match=message):
        SegmentationEstimator.load(tmp_path)


@pytest.mark.parametrize("estimator", [DepthEstimator, SegmentationEstimator])
def test_a_checkpoint_that_is_not_there(tmp_path: Path, estimator: type[DepthEstimator]) -> None:
    transformers()
    with pytest.raises(ValueError, match=r"neither a folder.*hf download nobody/nothing --local-dir FOLDER"):
        estimator.load("nobody/nothing", local_files_only=True)
    with pytest.raises(ValueError, match="there is no such folder"):
        estimator.load(tmp_path / "no folder", local_files_only=True)


@pytest.mark.parametrize("estimator", [DepthEstimator, SegmentationEstimator])
def test_without_transformers(monkeypatch: pytest.MonkeyPatch, estimator: type[DepthEstimator]) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ImportError, match=r"pip install 'vestcl\[estimators\]'"):
        estimator.load("nobody/nothing")


@pytest.mark.parametrize("weights", [DEPTH[1], CLASS[0]])
def test_damaged_weights_do_not_pass_as_an_answer(checkpoints: Path, weights: str) -> None:
    estimator = (DepthEstimator if weights in DEPTH else SegmentationEstimator).load(checkpoints / weights)
    for parameter in estimator.model.parameters():
        parameter.fill_(float("nan"))
    with pytest.raises(ValueError, match="must give finite"):
        estimator(noise_image())


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((48, 120, 3), np.float32), r"`images` must be \[B, 3, H, W\]"),
        (np.zeros((48, 120), np.float32), r"`image` must be \[3, H, W\], got \[48, 120\]"),
        (np.zeros((3, 4, 120), np.float32), "H and W of 5 or more"),
        (np.zeros((3, 48, 120), np.uint8), "must be floating-point numbers"),
        (np.full((3, 48, 120), 255, np.float32), r"must be in \[0, 1\], got 255 to 255"),
        (np.full((3, 48, 120), np.nan, np.float32), r"must be in \[0, 1\], got nan"),
    ],
)
def test_what_is_not_an_image(image: NDArray[np.generic], message: str) -> None:
    preparation = Preparation.read("", {"size": 32, "resample": 2, **HALVES}, zoe=False, size=None)
    for estimator in (
        DepthEstimator(None, preparation, None, False, "cpu"),
        SegmentationEstimator(None, preparation, ""),
    ):
        with pytest.raises(ValueError, match=message):
            estimator(image)
