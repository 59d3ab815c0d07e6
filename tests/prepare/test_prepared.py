"""A prepared clip's files: what is read is what was written, and nothing else is read as if it were."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from vestcl.constants import SKY_DEPTH
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, Sample
from vestcl.io.images import to_float, to_pixels
from vestcl.prepare.clip import EightBitPerception, prepare_clip
from vestcl.prepare.files import frame_path, read_tensors, write_clip, write_frame
from vestcl.prepare.prepared import PreparedClip, find_prepared
from vestcl.scene.layers import Layers
from vestcl.scene.perceived import PerceivedFrame

HEIGHT, WIDTH, FRAMES = 48, 160, 3


def street(frames: int = FRAMES) -> Clip:
    return street_clip(Street.generate(3), frames, HEIGHT, WIDTH, start=2.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street's clip, prepared; not to be written to."""
    folder = tmp_path_factory.mktemp("cache") / "street"
    assert prepare_clip(street(), folder) is not None
    return folder


@pytest.fixture
def noise(tmp_path: Path) -> tuple[Path, PerceivedFrame]:
    """A clip of one frame of noise, of an odd size."""
    rng, (height, width) = np.random.default_rng(0), (7, 9)
    mask = rng.random((1, height, width)) > 0.4
    image = to_float(rng.integers(0, 256, (height, width, 3), np.uint8))
    depth = rng.uniform(1, SKY_DEPTH, (1, height, width)).astype(np.float32)
    hidden = to_float(rng.integers(0, 256, (height, width, 3), np.uint8))
    background_depth = np.where(mask, depth, depth + rng.random(depth.shape, np.float32))
    layers = Layers(image, depth, mask, np.where(mask, image, hidden), background_depth)
    velocity = np.where(mask, 0, rng.normal(size=(3, height, width)).astype(np.float16)).astype(np.float32)
    own = rng.random((1, height, width)) > 0.7
    K = rng.random((3, 3)) * 0 + np.array([[1 / 3, 0, 4.1], [0, 1 / 7, 3.3], [0, 0, 1]])
    frame = PerceivedFrame("a frame", K, layers, velocity, own, None)
    write_frame(tmp_path, 0, "key", frame, None)
    write_clip(tmp_path, Clip("noise", "arrays", (Sample.from_arrays("a frame", image, K),)), ["key"])
    return tmp_path, frame


def same(got: PerceivedFrame, wanted: PerceivedFrame) -> None:
    for field in dataclasses.fields(Layers):
        got_plane, wanted_plane = getattr(got.layers, field.name), getattr(wanted.layers, field.name)
        assert got_plane.dtype == wanted_plane.dtype
        np.testing.assert_array_equal(got_plane, wanted_plane)
    np.testing.assert_array_equal(got.velocity, wanted.velocity)
    np.testing.assert_array_equal(got.own, wanted.own)
    np.testing.assert_array_equal(got.K, wanted.K)


def test_a_frame_of_noise_comes_back_bit_for_bit(noise: tuple[Path, PerceivedFrame]) -> None:
    folder, frame = noise
    clip = PreparedClip.open(folder)
    same(clip.frame(0), frame)
    assert clip.frame(0).name == clip.frame_name(0) == "a frame" and clip.frame(0).prev_from_cur is None
    assert (clip.name, clip.kind, clip.fps, clip.size, len(clip)) == ("noise", "arrays", None, (7, 9), 1)
    assert clip.right(0) is None and clip.right_camera(0) is None and clip.world_from_cam(0) is None


@pytest.mark.parametrize("background", [True, False])
def test_nothing_and_everything_hidden(noise: tuple[Path, PerceivedFrame], background: bool) -> None:
    folder, frame = noise
    layers, mask = frame.layers, np.full_like(frame.layers.mask, background)
    shown = {"background_image": layers.image, "background_depth": layers.depth} if background else {}
    wanted = dataclasses.replace(frame, layers=dataclasses.replace(layers, mask=mask, **shown))
    write_frame(folder, 0, "key", wanted, None)
    same(PreparedClip.open(folder).frame(0), wanted)
    pixels = 0 if background else mask.size
    assert read_tensors(folder, 0, "key")["background_depth"].shape == (pixels,)


def test_a_street_comes_back(folder: Path) -> None:
    clip, truth = PreparedClip.open(folder), street()
    perception = EightBitPerception(truth)
    assert (clip.name, clip.kind, clip.fps, clip.size) == ("street 3", "procedural street", 10, (HEIGHT, WIDTH))
    for index in range(FRAMES):
        got, wanted = clip.frame(index), perception.seen(index)
        for name in ("image", "depth", "mask", "background_depth"):
            np.testing.assert_array_equal(getattr(got.layers, name), getattr(wanted.layers, name))
        np.testing.assert_allclose(got.layers.background_image, wanted.layers.background_image, atol=0.5001 / 255)
        np.testing.assert_array_equal(got.velocity, wanted.velocity.astype(np.float16))
        np.testing.assert_array_equal(clip.image(index), got.layers.image)
        np.testing.assert_array_equal(clip.K(index), truth[index].K)
        np.testing.assert_array_equal(clip.world_from_cam(index), truth[index].world_from_cam)
        if index:
            np.testing.assert_array_equal(got.prev_from_cur, wanted.prev_from_cur)
    assert (clip.frame(1).velocity != 0).any()
    assert not clip.frame(0).layers.mask.all()


def test_the_background_is_never_nearer_and_differs_only_where_it_is_hidden(folder: Path) -> None:
    for index in range(FRAMES):
        layers = PreparedClip.open(folder).frame(index).layers
        background = layers.mask[0]
        np.testing.assert_array_equal(layers.background_image[:, background], layers.image[:, background])
        np.testing.assert_array_equal(layers.background_depth[:, background], layers.depth[:, background])
        assert (layers.background_depth >= layers.depth).all()
        assert (layers.background_image != layers.image).any(0)[~background].mean() > 0.5


def test_the_right_camera(folder: Path) -> None:
    clip, camera = PreparedClip.open(folder), street()[1].right
    assert camera is not None and clip.right_camera(0) is not None
    right = clip.right(1)
    assert right is not None
    np.testing.assert_array_equal(right[0], to_float(to_pixels(camera.read_image())))
    np.testing.assert_array_equal(right[1], camera.K)
    np.testing.assert_array_equal(right[2], camera.right_from_left)


def test_arrays_are_the_readers_own(folder: Path) -> None:
    clip = PreparedClip.open(folder)
    clip.K(0)[:] = 0
    clip.frame(0).layers.image[:] = 0
    frame = clip.frame(0)
    assert clip.K(0)[0, 0] > 0 and frame.layers.image.any() and frame.layers.depth.flags.writeable
    assert not np.shares_memory(frame.layers.background_depth, frame.layers.depth)


def test_only_what_is_asked_for_is_read(noise: tuple[Path, PerceivedFrame]) -> None:
    """Damage to the depth is no matter to who wants the image."""
    folder, frame = noise
    path = frame_path(folder, 0)
    content = path.read_bytes()
    start = content.index(frame.layers.depth.tobytes())
    path.write_bytes(content[:start] + bytes(4) + content[start + 4 :])
    clip = PreparedClip.open(folder)
    np.testing.assert_array_equal(clip.image(0), frame.layers.image)
    with pytest.raises(ValueError, match=r"000000.safetensors: is damaged \(the checksum of depth\); run `vestcl prep"):
        clip.frame(0)


@pytest.mark.parametrize("kept", [0, 5, 100, -1])
def test_a_truncated_file(noise: tuple[Path, PerceivedFrame], kept: int) -> None:
    folder, _ = noise
    path = frame_path(folder, 0)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"000000.safetensors: is damaged .*; run `vestcl prepare` again"):
        PreparedClip.open(folder).image(0)


def test_a_missing_file_and_one_of_another_run(noise: tuple[Path, PerceivedFrame]) -> None:
    folder, frame = noise
    clip = PreparedClip.open(folder)
    write_frame(folder, 0, "another key", frame, None)
    with pytest.raises(ValueError, match=r"000000.safetensors: was computed from other frames .* again"):
        clip.image(0)
    frame_path(folder, 0).unlink()
    with pytest.raises(ValueError, match=r"000000.safetensors: is missing; run `vestcl prepare` again"):
        clip.frame(0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"recipe": "vestcl prepared 0"}', "must be 'vestcl prepared 4', got 'vestcl prepared 0'; run `vestcl prep"),
        ('{"recipe": "vestcl prepared 4"}', "is damaged"),
        ("[]", "is damaged"),
        ('{"recipe": "vest', "is damaged"),
        ("\x00", "is damaged"),
    ],
)
def test_a_damaged_clip(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "clip.json").write_text(content)
    with pytest.raises(ValueError, match=f"clip.json: {message}"):
        PreparedClip.open(tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"fps": null', '"fps": 1000'),
        ("4.1", "4.2"),
        ('"checksum"', '"checksun"'),
        ('"name": "noise"', '"name": "nose"'),
    ],
)
def test_a_changed_clip(noise: tuple[Path, PerceivedFrame], old: str, new: str) -> None:
    """JSON that is whole, with another content than was written."""
    path = noise[0] / "clip.json"
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=r"clip.json: is damaged \((the|no) checksum\); run `vestcl prepare` again$"):
        PreparedClip.open(noise[0])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"F32","shape":[7,9]', '"I32","shape":[7,9]', r"depth must be float32 \[7, 9\], got int32 \[7, 9\]"),
        ('"F32","shape":[7,9]', '"F32","shape":[9,7]', r"depth must be float32 \[7, 9\], got float32 \[9, 7\]"),
        ('"mask":{', '"musk":{', "mask"),
        ('\\"checksums\\"', '\\"checksumz\\"', "no entry 'checksums'"),
        ('"vestcl"', '"vastcl"', "no entry 'vestcl'"),
    ],
)
def test_a_changed_header(noise: tuple[Path, PerceivedFrame], old: str, new: str, message: str) -> None:
    path = frame_path(noise[0], 0)
    content = path.read_bytes()
    assert content.count(old.encode()) == 1
    path.write_bytes(content.replace(old.encode(), new.encode()))
    with pytest.raises(ValueError, match=rf"^[^\n]*000000.safetensors: is damaged \([^\n]*{message}[^\n]*\); run"):
        PreparedClip.open(noise[0]).frame(0)


def test_no_clip(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"clip.json: No such file"):
        PreparedClip.open(tmp_path)


@pytest.mark.parametrize("index", [-1, FRAMES])
def test_no_such_frame(folder: Path, index: int) -> None:
    clip = PreparedClip.open(folder)
    for read in (clip.frame, clip.image, clip.right, clip.K, clip.world_from_cam, clip.frame_name):
        with pytest.raises(ValueError, match=rf"`index` must be 0 ... {FRAMES - 1}, a frame of street 3, got {index}"):
            read(index)


def test_finding(noise: tuple[Path, PerceivedFrame], tmp_path: Path) -> None:
    about = json.loads((tmp_path / "clip.json").read_text())
    del about["checksum"]  # as files of vestcl 0.3, which can be read
    (tmp_path / "clip.json").unlink()
    for place in ("set/.vestcl/b", "set/.vestcl/a", "set/c/deep", "other"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "clip.json").write_text(json.dumps(about | {"name": place}))
    (tmp_path / "set" / "incomplete").mkdir()
    frame_path(tmp_path, 0).rename(frame_path(tmp_path / "set" / "incomplete", 0))

    def names(root: Path | str) -> list[str]:
        return [clip.name for clip in find_prepared(root)]

    assert names(tmp_path / "set") == ["set/.vestcl/a", "set/.vestcl/b", "set/c/deep"]
    assert names(str(tmp_path / "other")) == ["other"]
    assert names(tmp_path / "set" / ".vestcl" / "[b]") == ["set/.vestcl/b"]
    assert names(tmp_path / "*t*") == ["other", "set/.vestcl/a", "set/.vestcl/b", "set/c/deep"]
    for nothing in (tmp_path / "set" / "incomplete", tmp_path / "nowhere", tmp_path / "x*"):
        with pytest.raises(ValueError, match="has no prepared clip; `vestcl prepare` makes them"):
            find_prepared(nothing)
