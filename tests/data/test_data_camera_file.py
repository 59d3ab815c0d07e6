"""vestcl.data.readers.camera_file: what camera.json may not hold, and a short fuzz of it through the reader of
folders."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data_files import write_images, write_text

from vestcl.data.readers import folder
from vestcl.data.readers.camera_file import SCHEMA, read_camera
from vestcl.data.readers.folder import open_folder
from vestcl.io.strict_json import parse_json

CAMERA: dict[str, Any] = {"fx": 70.0, "fy": 71, "cx": 4.0, "cy": 3.0}


@pytest.mark.parametrize("key", ["fx", "fy", "cx", "cy"])
@pytest.mark.parametrize("value", [None, True, False, "70", [70], {}])
def test_numbers_that_are_none(tmp_path: Path, key: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"camera\.json: must have the numbers {key}$"):
        read_camera(write_text(tmp_path / "camera.json", json.dumps(CAMERA | {key: value})))


@pytest.mark.parametrize("key", ["width", "height", "fps", "depth_scale", "baseline"])
@pytest.mark.parametrize("value", [True, False, 0, -1, "5", [5], {}])
def test_positive_numbers(tmp_path: Path, key: str, value: object) -> None:
    content = CAMERA | {"width": 8, "height": 6} | {key: value}
    with pytest.raises(ValueError, match=rf"camera\.json: `{key}` must be a positive number, got "):
        read_camera(write_text(tmp_path / "camera.json", json.dumps(content)))


@pytest.mark.parametrize("key", ["fx", "fy", "cx", "cy", "width", "height", "fps", "depth_scale", "baseline", "k1"])
@pytest.mark.parametrize("value", [1e300, 10**400, 1e12])
def test_numbers_beyond_all_cameras(tmp_path: Path, key: str, value: float) -> None:
    content = CAMERA | {"width": 8, "height": 6} | {key: value}
    with pytest.raises(ValueError, match=rf"camera\.json: `{key}` must be at most [\w.+]+, got .{{1,60}}$"):
        read_camera(write_text(tmp_path / "camera.json", json.dumps(content)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"fx": NaN, "fy": 1, "cx": 1, "cy": 1}', r"is not JSON \(NaN is not a number in JSON\)"),
        ('{"fx": Infinity}', r"is not JSON \(Infinity is not a number in JSON\)"),
        ('{"fx": -Infinity}', r"is not JSON \(-Infinity is not a number in JSON\)"),
        ('{"fx": 1e999, "fy": 1, "cx": 1, "cy": 1}', "`fx` must be at most"),
        ('{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "fx": 2}', r"is not JSON \(the key 'fx' is there twice\)"),
        ("[" * 100_000, r"is not JSON \(nested too deeply\)"),
        ('{"a":' * 100_000, r"is not JSON \(nested too deeply\)"),
        ('{"fx": ' + "9" * 5000 + "}", r"is not JSON \("),
        ("", r"is not JSON \("),
        ("null", "must be an object"),
        (' {"fx": 1} trailing', r"is not JSON \("),
        ("x" * (1 << 21), "must have at most 1048576 bytes, got 2097153"),
        ('{"pixel_center": "half"}', r"unknown keys pixel_center \(did you mean pixel_centre\?\); it may have fx, fy"),
        ('{"depthscale": 256}', r"unknown keys depthscale \(did you mean depth_scale\?\)"),
        ('{"witdh": 8}', r"unknown keys witdh \(did you mean width\?\)"),
        ('{"\\n\\u001b": 8}', r"unknown keys '\\n\\x1b'; it may have fx"),
    ],
)
def test_texts(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=rf"camera\.json: {message}") as error:
        read_camera(write_text(tmp_path / "camera.json", text))
    assert "\n" not in str(error.value)


def test_what_is_no_file(tmp_path: Path) -> None:
    write_images(tmp_path / "image", ["a.png"])
    path = tmp_path / "camera.json"
    path.mkdir()
    with pytest.raises(ValueError, match=r"camera\.json: Is a directory"):
        open_folder(tmp_path)
    path.rmdir()
    os.mkfifo(path)
    with pytest.raises(ValueError, match=r"camera\.json: must be a regular file, got a FIFO"):
        open_folder(tmp_path)
    path.unlink()
    path.symlink_to("nowhere")
    with pytest.raises(ValueError, match=r"camera\.json: No such file"):
        open_folder(tmp_path)
    path.unlink()
    path.write_bytes(b"\xff\xfe{")
    with pytest.raises(ValueError, match=r"camera\.json: is not JSON"):
        open_folder(tmp_path)


def mutated(rng: np.random.Generator) -> str:
    """A camera.json with up to three keys changed, or with its text damaged."""
    odd: list[Any] = [
        *(
            None,
            True,
            False,
            0,
            -0.0,
            -1,
            1,
            0.5,
            3,
            8,
            6,
            1e300,
            -1e300,
            1e-300,
            10**400,
            2**63,
            "",
            "half",
            "fisheye",
        ),
        *([], {}, [1.0], {"fx": 1}, "NaN", "\u0000", "trainIds", 1e15),
        {"fx": 60, "fy": 61, "cx": 3, "cy": 2, "width": 8, "height": 6, "k1": 0.1},
    ]
    keys = [
        *("fx", "fy", "cx", "cy", "width", "height", "pixel_centre", "fps", "depth_scale", "label_ids", "baseline"),
        *("right", "distortion", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "Fx", "k7", ""),
    ]
    content = CAMERA | {"baseline": 0.5, "depth_scale": 256, "label_ids": "trainIds"}
    for _ in range(int(rng.integers(4))):
        content[keys[rng.integers(len(keys))]] = odd[rng.integers(len(odd))]
    text = json.dumps(content)
    if rng.random() < 0.3:
        at = int(rng.integers(len(text)))
        text = text[:at] + ["", "[", "}", '"', ",", "NaN", "1e999", "\\", "\x00"][rng.integers(9)] + text[at + 1 :]
    return text


def refusal(path: Path) -> str:
    try:
        read_camera(path)
    except ValueError as error:
        return str(error)
    return ""


def test_the_schema_says_what_the_reader_does(tmp_path: Path) -> None:
    """By another implementation of JSON Schema: what it accepts is read, what it refuses is refused, by key."""
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(SCHEMA)
    validator.check_schema(SCHEMA)
    path, verdicts = tmp_path / "camera.json", []
    for seed in range(3000):
        text = mutated(np.random.default_rng(seed))
        try:
            content = parse_json(text.encode())
        except ValueError:
            continue
        path.write_text(text, encoding="utf-8")
        verdicts.append(validator.is_valid(content))
        message = refusal(path)
        # A schema can't say that the right camera needs numbers of its own where the left lens is not 0.
        assert verdicts[-1] == (not message) or "must have its own distortion" in message, text
    assert sum(verdicts) > 300 and len(verdicts) - sum(verdicts) > 300


@pytest.mark.parametrize("key", sorted(SCHEMA["properties"]))
def test_every_key_is_documented(key: str) -> None:
    assert re.search(rf"\b{key}\b", folder.__doc__ or "") or key in ("k2", "k4", "k5")
    assert SCHEMA["properties"][key]["description"]


def test_fuzz(tmp_path: Path) -> None:
    """Opened with a camera that is one, or refused in one line that names the file; seeds 0 to 599."""
    for kind in ("image", "right"):
        write_images(tmp_path / kind, ["a.png"])
    path, opened, messages = tmp_path / "camera.json", 0, []
    for seed in range(600):
        path.write_text(mutated(np.random.default_rng(seed)), encoding="utf-8")
        try:
            sample = open_folder(tmp_path)[0]
        except ValueError as error:
            messages.append(str(error))
        else:
            opened += 1
            for camera in (sample, sample.right):
                assert camera is not None
                assert np.isfinite(camera.K).all() and 0 <= camera.K[0, 2] <= 8 and 0 <= camera.K[1, 2] <= 6
            assert np.isfinite(sample.read_image()).all()
    assert opened > 100 and len(messages) > 100
    assert all("camera.json: " in message and message.isprintable() and len(message) < 2000 for message in messages)
