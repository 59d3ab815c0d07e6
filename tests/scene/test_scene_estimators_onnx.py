"""Estimators by ONNX files: what is fed, what comes back, and what is refused with which remedy."""

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data_files import real
from onnx_files import FLOAT16, INT64, UINT8, field, model, node, tensor, value_info, write_mix

from vestcl.cli import checks as forecast_checks
from vestcl.data.open import open_sequence
from vestcl.scene.estimators import OnnxDepth, OnnxSegmentation
from vestcl.scene.estimators._class_tables import TABLES
from vestcl.scene.estimators._onnx_file import Value, read_onnx
from vestcl.scene.estimators.onnx import FARTHEST, network_files

RED, GREEN, BLUE = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "network.onnx"


@pytest.fixture
def image() -> np.ndarray:
    """[3, 8, 12], all pixels different."""
    return np.random.default_rng(0).uniform(0.2, 0.9, (3, 8, 12)).astype(np.float32)


def test_the_interface_is_read_from_the_file(file: Path) -> None:
    write_mix(file, [RED], (4, 6))
    found = read_onnx(file)
    assert found.inputs == (Value("image", "float32", (1, 3, 4, 6)),)
    assert found.outputs == (Value("result", "float32", (1, 1, 4, 6)),)


def test_weights_that_are_listed_as_inputs_are_none(file: Path) -> None:
    conv = node("Conv", ["x", "w"], "y", kernel_shape=[1, 1])
    inputs = [value_info("w", [1, 3, 1, 1]), value_info("x", [1, 3, 6, 8])]
    file.write_bytes(model([conv], inputs, [value_info("y", [1, 1, 6, 8])], [tensor("w", np.ones((1, 3, 1, 1), "f"))]))
    assert [value.name for value in read_onnx(file).inputs] == ["x"]
    assert OnnxDepth.load(file)(np.full((3, 6, 8), 0.5, np.float32)) == pytest.approx(1.5)


@pytest.mark.parametrize("nhwc", [False, True])
@pytest.mark.parametrize(("colour", "weights"), [("RGB", RED), ("BGR", BLUE)])
def test_layout_and_colour(file: Path, image: np.ndarray, nhwc: bool, colour: str, weights: list[float]) -> None:
    depth = OnnxDepth.load(write_mix(file, [weights], (8, 12), nhwc=nhwc, colour=colour, metres=10))
    np.testing.assert_allclose(depth(image), 10 * image[:1], rtol=1e-5)


def test_normalisation(file: Path, image: np.ndarray) -> None:
    write_mix(file, [GREEN], (8, 12), bias=[5.0], scale=0.5, mean=[10, 20, 30], std=[1, 4, 8])
    np.testing.assert_allclose(OnnxDepth.load(file)(image), (0.5 * 255 * image[1:2] - 20) / 4 + 5, rtol=1e-4)


def test_grey(file: Path, image: np.ndarray) -> None:
    grey = OnnxDepth.load(write_mix(file, [[2.0]], (8, 12), colour="grey"))(image)
    np.testing.assert_allclose(grey[0], 2 * np.tensordot([0.299, 0.587, 0.114], image, 1), rtol=1e-5)


def test_bytes_are_fed_as_they_are(file: Path, image: np.ndarray) -> None:
    depth = OnnxDepth.load(write_mix(file, [RED], (8, 12), kind=UINT8, metres=0.1))(image)
    np.testing.assert_allclose(depth, np.rint(image[:1] * 255) / 10, rtol=1e-5)


def test_classes_are_normalised_as_imagenet_unless_the_json_says_otherwise(file: Path, image: np.ndarray) -> None:
    # Class 1 where the normalised red is above 0: above .485, or above 0.5 of a plain one.
    scores = [[0.0] * 3, RED]
    ids = OnnxSegmentation.load(write_mix(file, scores, (8, 12), classes=[0, 13]))(image)
    np.testing.assert_array_equal(ids == 13, image[:1] > 0.485)
    plain = write_mix(file, scores, (8, 12), bias=[0.0, -0.7], classes=[0, 13], std=1)
    np.testing.assert_array_equal(OnnxSegmentation.load(plain)(image) == 13, image[:1] > 0.7)


def test_stretch_and_letterbox(file: Path) -> None:
    """A square image in an input twice as wide as high: all of it, or the middle of it with repeated edges."""
    image = np.tile(np.linspace(0.1, 0.9, 8, dtype=np.float32), (3, 8, 1))
    for fit in ("stretch", "letterbox"):
        network = OnnxDepth.load(write_mix(file, [RED], (8, 16), fit=fit)).network
        fed = network.run(image)[0, 0]
        if fit == "letterbox":
            np.testing.assert_allclose(fed[:, 4:12], image[0], rtol=1e-5)
            assert (fed[:, :4] == fed[:, 4:5]).all() and (fed[:, 12:] == fed[:, 11:12]).all()
        else:
            assert fed[0, 0] == pytest.approx(0.1) and np.all(np.diff(fed[0, 1:-1]) > 0)
        np.testing.assert_allclose(OnnxDepth(network)(image), image[:1], atol=0.02)


@pytest.mark.parametrize("fit", ["stretch", "letterbox"])
@pytest.mark.parametrize("pool", [1, 2, 4])
def test_outputs_of_any_size_come_back_to_the_images_size(file: Path, fit: str, pool: int) -> None:
    """A ramp is a ramp wherever the output's pixels lie, up to half an output pixel at the edges."""
    x = np.arange(60, dtype=np.float32) + 0.5
    image = np.broadcast_to(x / 60, (3, 40, 60))
    depth = OnnxDepth.load(write_mix(file, [RED], (32, 64), pool=pool, fit=fit, metres=60))(image)
    assert depth.shape == (1, 40, 60)
    np.testing.assert_allclose(depth[0, 20, 5:-5], x[5:-5], atol=0.1)


@pytest.mark.parametrize(
    ("description", "wanted"),
    [
        ({}, lambda v: v),
        ({"meaning": "depth_m", "metres": 20}, lambda v: 20 * v),
        ({"meaning": "disparity", "metres": 3}, lambda v: 3 / v),
        ({"meaning": "disparity", "metres": 3, "offset": 0.5}, lambda v: 3 / (v + 0.5)),
    ],
)
def test_meanings_of_depth(file: Path, image: np.ndarray, description: dict[str, Any], wanted: Any) -> None:
    estimator = OnnxDepth.load(write_mix(file, [RED], (8, 12), **description))
    assert estimator.metric
    np.testing.assert_allclose(estimator(image), wanted(image[:1]), rtol=1e-5)


def test_a_depth_without_a_unit_is_up_to_scale(file: Path, image: np.ndarray) -> None:
    estimator = OnnxDepth.load(write_mix(file, [RED], (8, 12), meaning="inverse_depth"))
    depth = estimator(image)
    assert not estimator.metric and np.median(depth) == pytest.approx(10, rel=1e-5)
    np.testing.assert_allclose(depth * image[:1], (depth * image[:1])[0, 0, 0], rtol=1e-4)


def test_no_disparity_is_far_away(file: Path, image: np.ndarray) -> None:
    depth = OnnxDepth.load(write_mix(file, [RED], (8, 12), bias=[-0.5], meaning="disparity", metres=1))(image)
    assert depth.max() <= FARTHEST and depth[image[:1] < 0.5] == pytest.approx(FARTHEST)


@pytest.mark.parametrize(
    ("description", "wanted"),
    [
        ({"classes": "ade20k"}, {6: 0, 20: 13, 2: 10, 12: 11, 149: 255}),
        ({"classes": "pascal_voc"}, {7: 13, 15: 11, 0: 255}),
        ({"classes": "cityscapes_label_ids"}, {7: 0, 26: 13, 23: 10, 0: 255}),
        ({"classes": [0, 10, 255, 13]}, {0: 0, 1: 10, 2: 255, 3: 13, 4: 255}),
        ({"movable": [3, 4], "sky": [1]}, {0: 255, 1: 10, 3: 13, 4: 13, 9: 255}),
    ],
)
def test_classes_become_train_ids(file: Path, description: dict[str, Any], wanted: dict[int, int]) -> None:
    """A network that gives the red bytes themselves as class indices."""
    write_mix(file, [RED], (8, 16), scale=1, meaning="classes", **description)
    image = np.zeros((3, 8, 16), np.float32)
    image[0, 0, : len(wanted)] = np.array(list(wanted)) / 255
    assert list(OnnxSegmentation.load(file)(image)[0, 0, : len(wanted)]) == list(wanted.values())


def test_class_indices_as_argmax_gives_them(file: Path, image: np.ndarray) -> None:
    nodes = [node("ArgMax", ["x"], "y", axis=1, keepdims=0)]
    file.write_bytes(model(nodes, [value_info("x", [1, 3, 4, 6])], [value_info("y", [1, 4, 6], INT64)]))
    file.with_suffix(".json").write_text(json.dumps({"meaning": "classes", "classes": [0, 10, 13], "std": 1}))
    large = image[:, ::2, ::2].repeat(2, 1).repeat(2, 2)
    ids = OnnxSegmentation.load(file)(large)
    np.testing.assert_array_equal(ids[0], np.array([0, 10, 13])[large.argmax(0)])


def test_scores_on_the_last_axis(file: Path, image: np.ndarray) -> None:
    nodes = [node("Transpose", ["x"], "y", perm=[0, 2, 3, 1])]
    file.write_bytes(model(nodes, [value_info("x", [1, 3, 8, 12])], [value_info("y", [1, 8, 12, 3])]))
    file.with_suffix(".json").write_text(json.dumps({"classes": [0, 10, 13], "std": 1}))
    ids = OnnxSegmentation.load(file)(image)
    np.testing.assert_array_equal(ids[0], np.array([0, 10, 13])[image.argmax(0)])


def test_scores_of_a_network_of_which_only_the_movable_classes_are_known(file: Path, image: np.ndarray) -> None:
    write_mix(file, [RED, GREEN, BLUE], (8, 12), movable=[2], sky=[0], std=1)
    ids = OnnxSegmentation.load(file)(image)
    np.testing.assert_array_equal(ids[0], np.array([10, 255, 13])[image.argmax(0)])


def test_tables_hold_train_ids() -> None:
    assert {name: len(table) for name, table in TABLES.items()} == {
        "cityscapes": 19, "cityscapes_label_ids": 34, "ade20k": 150, "pascal_voc": 21,
    }  # fmt: skip
    assert all(index in (*range(19), 255) for table in TABLES.values() for index in table)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"colur": "RGB"}, r"unknown key colur \(did you mean colour\?\)"),
        ({"color": "RGB"}, r"unknown key color \(did you mean colour\?\)"),
        ({"zzz": 1}, r"unknown key zzz \(did you mean \w+\?\); it may have file, input"),
        ({"movable": [1]}, "key movable is for a network of classes"),
        ({"colour": "bgr"}, r"colour must be RGB or BGR or grey, got 'bgr' \(did you mean BGR\?\)"),
        ({"meaning": "depth"}, r"meaning must be depth_m or disparity or inverse_depth, got 'depth'.*depth_m"),
        ({"meaning": "disparity"}, 'meaning disparity needs "metres"'),
        ({"meaning": "inverse_depth", "metres": 2}, "has no unit and takes no metres"),
        ({"offset": 2}, "depth_m takes no offset"),
        ({"scale": 0}, "scale must be a number above 0, got 0"),
        ({"scale": True}, "scale must be a number above 0, got True"),
        ({"mean": [1, 2]}, r"mean must be a number or 3 numbers, got \[1, 2\]"),
        ({"std": [1, 0, 1]}, r"std must be above 0, got \[1, 0, 1\]"),
        ({"size": [6, 4]}, r"its input is 4 x 6 px, and its JSON has \(6, 4\)"),
        ({"size": 4}, r"size must be \[height, width\] in px, got 4"),
        ({"layout": "NHWC"}, r"must be NHWC with 3 channels \(RGB\), got `image` float32 \[1, 3, 4, 6\]"),
        ({"colour": "grey"}, r"with 1 channels \(grey\), got `image`"),
        ({"output": "other"}, r"has no output other; it has `result` float32 \[1, 1, 4, 6\]"),
        ({"input": ""}, "input must be a name, got ''"),
    ],
)
def test_descriptions_are_read_strictly(file: Path, description: dict[str, Any], message: str) -> None:
    write_mix(file, [RED], description=description)
    with pytest.raises(ValueError, match=message):
        OnnxDepth.load(file)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"classes": "city"}, "classes must be cityscapes, cityscapes_label_ids, ade20k, pascal_voc or a list"),
        ({"classes": [19]}, "classes must be .* or a list of train ids"),
        ({"classes": [0, 1], "sky": [2]}, "must have classes, or movable and sky, got classes and sky"),
        ({"metres": 2}, "key metres is for a network of depth"),
        ({"movable": [-1]}, "movable must be a list of class indices from 0"),
        ({"movable": [3]}, "has 3 classes, and its JSON lists class 3"),
        ({"classes": "ade20k"}, r"must give scores of 150 classes, .* got result \[1, 3, 4, 6\]"),
        ({"meaning": "classes"}, r"must be one value per pixel, \[1, 1, H, W\], got result \[1, 3, 4, 6\]"),
    ],
)
def test_descriptions_of_classes_are_read_strictly(file: Path, description: dict[str, Any], message: str) -> None:
    write_mix(file, [RED, GREEN, BLUE], description=description)
    with pytest.raises(ValueError, match=message):
        OnnxSegmentation.load(file)


def test_a_json_that_is_none(file: Path) -> None:
    write_mix(file, [RED])
    for text, message in (("{", "is not JSON"), ("[1]", "must be an object"), ('{"std": NaN}', "is not JSON")):
        file.with_suffix(".json").write_text(text)
        with pytest.raises(ValueError, match=message):
            OnnxDepth.load(file)


@pytest.mark.parametrize(
    "axes", [["batch", 3, "height", "width"], ["batch", 3, 4, 6], [1, 3, 4, "width"], [1, 3, 0, 6]]
)
def test_dynamic_axes_are_refused_with_the_remedy(file: Path, axes: list[int | str]) -> None:
    file.write_bytes(model([node("Relu", ["image"], "y")], [value_info("image", axes)], [value_info("y", axes)]))
    with pytest.raises(ValueError, match=r"dynamic axes.*fixed.*make_dynamic_shape_fixed --input_name image") as caught:
        OnnxDepth.load(file)
    assert f"--input_shape {'1' if axes[0] == 'batch' else axes[0]},3," in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "kind", "message"),
    [
        ([4, 3, 4, 6], 1, "export it with a batch of 1"),
        ([1, 5, 4, 6], 1, r"NCHW or NHWC with 3 channels \(RGB\)"),
        ([1, 3], 1, "must be one image"),
        ([1, 3, 4, 6], INT64, "of float32, float16, uint8, got `image` int64"),
    ],
)
def test_inputs_that_are_no_image(file: Path, shape: list[int], kind: int, message: str) -> None:
    file.write_bytes(
        model([node("Relu", ["image"], "y")], [value_info("image", shape, kind)], [value_info("y", shape)])
    )
    with pytest.raises(ValueError, match=message):
        OnnxDepth.load(file)


def test_a_layer_that_opencv_does_not_have_is_named(file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shape = [1, 3, 4, 6]
    file.write_bytes(model([node("Frobnicate", ["x"], "y")], [value_info("x", shape)], [value_info("y", shape)]))
    with pytest.raises(
        ValueError, match=r"cannot read this network: .*Frobnicate_0 of type Frobnicate.*opset"
    ) as caught:
        OnnxDepth.load(file)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_network_that_can_be_read_but_not_run(file: Path) -> None:
    shape = [1, 3, 4, 6]
    nodes = [node("GridSample", ["x", "x"], "y")]
    file.write_bytes(model(nodes, [value_info("x", shape)], [value_info("y", shape)]))
    with pytest.raises(ValueError, match=r"OpenCV .* cannot (read|run) this network"):
        OnnxDepth.load(file)


def test_several_outputs_need_a_name(file: Path, image: np.ndarray) -> None:
    shape = [1, 3, 8, 12]
    nodes = [node("ReduceMax", ["x"], "large", axes=[1]), node("ReduceMin", ["x"], "small", axes=[1])]
    outputs = [value_info(name, [1, 1, 8, 12]) for name in ("large", "small")]
    file.write_bytes(model(nodes, [value_info("x", shape)], outputs))
    with pytest.raises(ValueError, match=r'must name one output, as "output" in its JSON; it has `large` .*`small`'):
        OnnxDepth.load(file)
    for name, wanted in (("large", image.max(0)), ("small", image.min(0))):
        file.with_suffix(".json").write_text(json.dumps({"output": name}))
        np.testing.assert_allclose(OnnxDepth.load(file)(image)[0], wanted, rtol=1e-5)


@pytest.mark.parametrize("keep", [0, 1, 7, 40, 100, -1])
def test_truncated_files(file: Path, keep: int) -> None:
    content = write_mix(file, [RED]).read_bytes()
    file.write_bytes(content[:keep])
    with pytest.raises(ValueError, match=r"network.onnx: is not an ONNX file, or a truncated one"):
        OnnxDepth.load(file)


@pytest.mark.parametrize("content", [b"<html>no</html>", b"version https://git-lfs.github.com/spec/v1\n", b"\xff" * 99])
def test_files_of_another_kind(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(ValueError, match="is not an ONNX file"):
        OnnxDepth.load(file)


def test_weights_in_another_file_that_is_missing(file: Path) -> None:
    external = b"".join(
        field(13, field(1, key) + field(2, value)) for key, value in (("location", "w.data"), ("offset", "0"))
    )
    weights = b"".join(field(1, size) for size in (1, 3, 1, 1)) + field(2, 1) + field(8, "w") + external + field(14, 1)
    conv = node("Conv", ["x", "w"], "y", kernel_shape=[1, 1])
    content = model([conv], [value_info("x", [1, 3, 4, 6])], [value_info("y", [1, 1, 4, 6])], [weights])
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"its weights are in .*w.data, which does not exist"):
        OnnxDepth.load(file)
    (file.parent / "w.data").write_bytes(np.ones(3, np.float32).tobytes())
    assert network_files(file) == [file, file.parent / "w.data"]


def test_answers_that_are_not_finite(file: Path, image: np.ndarray) -> None:
    nodes = [node("ReduceMax", ["x"], "red", axes=[1]), node("Neg", ["red"], "neg"), node("Sqrt", ["neg"], "y")]
    file.write_bytes(model(nodes, [value_info("x", [1, 3, 8, 12])], [value_info("y", [1, 1, 8, 12])]))
    depth = OnnxDepth.load(file)
    with pytest.raises(ValueError, match="must give finite depths"):
        depth(image)


def test_half_precision_inputs(file: Path, image: np.ndarray) -> None:
    depth = OnnxDepth.load(write_mix(file, [RED], (8, 12), kind=FLOAT16))
    np.testing.assert_allclose(depth(image), image[:1], rtol=2e-3)


# ---------------------------------------------------------------- files, folders, names


def test_a_description_may_name_its_network(tmp_path: Path, image: np.ndarray) -> None:
    (tmp_path / "there").mkdir()
    write_mix(tmp_path / "there" / "network.onnx", [RED], (8, 12))
    described = tmp_path / "mine.json"
    described.write_text(json.dumps({"file": "there/network.onnx", "metres": 3}))
    np.testing.assert_allclose(OnnxDepth.load(described)(image), 3 * image[:1], rtol=1e-5)
    assert network_files(described) == [tmp_path / "there" / "network.onnx", described]
    described.write_text(json.dumps({"file": "nowhere.onnx"}))
    with pytest.raises(ValueError, match=r'there is no file .*nowhere.onnx; the key "file" names the ONNX file'):
        OnnxDepth.load(described)


def test_files_folders_and_names_are_distinguished_by_what_exists(tmp_path: Path) -> None:
    def is_file(path: Path | str) -> bool:
        return forecast_checks.is_network_file("depth_model", str(path))

    assert is_file(write_mix(tmp_path / "a.onnx", [RED]))
    assert is_file((tmp_path / "a.onnx").rename(tmp_path / "without_suffix"))
    (tmp_path / "folder.onnx").mkdir()
    assert not is_file(tmp_path / "folder.onnx")
    assert not is_file("Intel/zoedepth-nyu-kitti")
    for name in ("owner/missing.onnx", "missing.json"):
        with pytest.raises(ValueError, match=f"`depth_model` .*there is no file {name}"):
            is_file(name)
    (tmp_path / "model.safetensors").write_bytes(b"1")
    with pytest.raises(ValueError, match="holds weights without their network: give its folder"):
        is_file(tmp_path / "model.safetensors")
    write_mix(tmp_path / "folder.onnx" / "b.onnx", [RED])
    with pytest.raises(ValueError, match=r"without config.json.*folder.onnx/b.onnx"):
        is_file(tmp_path / "folder.onnx")


def test_defaults_are_logged(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    OnnxDepth.load(write_mix(file, [RED]))
    assert "without network.json its output is taken as metres" in caplog.text
    caplog.clear()
    OnnxDepth.load(write_mix(file, [RED], fit="letterbox"))
    assert caplog.text == ""


def test_threads_may_share_a_network(file: Path) -> None:
    depth = OnnxDepth.load(write_mix(file, [RED], (64, 64)))
    images = [np.full((3, 64, 64), value, np.float32) for value in (0.2, 0.4, 0.6, 0.8)]
    wrong: list[float] = []

    def run(image: np.ndarray) -> None:
        wrong.extend(float(z) for z in (depth(image).mean() for _ in range(20)) if abs(z - image.mean()) > 1e-4)

    threads = [threading.Thread(target=run, args=(image,)) for image in images]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


# ---------------------------------------------------------------- public networks


def test_a_public_depth_network_on_kitti() -> None:
    depth = OnnxDepth.load(real("models") / "rtmonodepth_s_kitti.onnx")
    sample = open_sequence(real("kitti_clip"))[30]
    scan, found = sample.read_depth(), depth(sample.read_image())
    ratios = found[scan > 0] / scan[scan > 0]
    assert 0.9 < np.median(ratios) < 1.1


def test_a_public_network_of_classes_on_kitti() -> None:
    classes = OnnxSegmentation.load(real("models") / "sinet_cityscapes.onnx")
    sample = open_sequence(real("kitti_clip"))[30]
    ids, labels = classes(sample.read_image()), sample.read_labels()
    assert (ids[labels == 13] == 13).mean() > 0.8
    assert (ids[labels == 0] == 0).mean() > 0.5
