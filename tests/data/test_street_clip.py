"""A street as a clip: the images that it renders, once each, and those who read clips reading it."""

import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from vestcl import opencl
from vestcl.data import STREET_SKY_DEPTH, Label, Street, intrinsics, street_clip
from vestcl.data.calibration import invert, translation
from vestcl.data.street import clip as clip_module
from vestcl.scene.depth.stereo import stereo_depth

HEIGHT, WIDTH = 48, 160


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    """No frame of another test or device."""
    clip_module._rendered.cache_clear()
    yield
    clip_module._rendered.cache_clear()


def test_frames_are_the_streets(session: opencl.Session) -> None:
    street = Street.generate(2)
    clip = street_clip(street, 3, HEIGHT, WIDTH, start=1.0, fps=5.0, baseline=0.6, samples=2)
    assert len(clip) == 3
    assert clip.fps == 5.0
    for index, sample in enumerate(clip):
        assert sample.timestamp == pytest.approx(1.0 + index / 5)
        assert np.array_equal(sample.K, intrinsics(HEIGHT, WIDTH))
        assert np.array_equal(sample.world_from_cam, street.camera_pose(sample.timestamp))
        left = invert(street.camera_pose(sample.timestamp))
        frame = street.render(left, sample.K, HEIGHT, WIDTH, sample.timestamp, samples=2)
        assert np.array_equal(sample.read_image(), frame.colour[0])
        assert np.array_equal(sample.read_depth(), frame.depth[0])
        assert np.array_equal(sample.read_labels(), frame.labels[0])
        aside = translation((-0.6, 0, 0)) @ left
        right = street.render(aside, sample.K, HEIGHT, WIDTH, sample.timestamp, samples=2)
        assert np.array_equal(sample.right.read_image(), right.colour[0])
        assert np.array_equal(sample.right.right_from_left, translation((-0.6, 0, 0)))
        assert np.array_equal(sample.right.K, sample.K)


def test_every_image_is_rendered_once(session: opencl.Session) -> None:
    clip = street_clip(Street.generate(0), 2, HEIGHT, WIDTH)
    rendered = clip_module._rendered.cache_info
    assert rendered().misses == 0
    first = clip[0]
    image = first.read_image()
    first.read_depth(), first.read_labels(), first.read_mask()
    assert rendered().misses == 1
    first.right.read_image(), clip[1].read_depth()
    assert rendered().misses == 3
    image[:] = 0  # a reader's own copy
    assert clip[0].read_image().mean() > 0.1
    assert rendered().misses == 3


def test_reads_as_any_clip(session: opencl.Session) -> None:
    clip = street_clip(Street.generate(1), 3, HEIGHT, WIDTH)
    labels, depth = clip[0].read_labels(), clip[0].read_depth()
    assert np.array_equal(depth == STREET_SKY_DEPTH, labels == Label.SKY)
    assert np.array_equal(clip[0].read_mask(), ~np.isin(labels, (Label.CAR, Label.POLE, Label.PERSON)))
    small = clip.resized(24, 80)
    assert small[1].read_image().shape == (3, 24, 80)
    assert small[1].read_depth().shape == (1, 24, 80)
    assert small[1].right.read_image().shape == (3, 24, 80)
    np.testing.assert_allclose(small[1].K, intrinsics(24, 80))
    moved = clip.from_first_pose()
    np.testing.assert_allclose(moved[0].world_from_cam, np.eye(4), atol=1e-12)
    assert 0.4 < moved[1].world_from_cam[2, 3] < 1.5
    again = pickle.loads(pickle.dumps(clip))
    assert np.array_equal(again[2].read_image(), clip[2].read_image())


def test_background_clip(session: opencl.Session) -> None:
    street = Street.generate(3)
    whole, bare = street_clip(street, 1, HEIGHT, WIDTH)[0], street_clip(street, 1, HEIGHT, WIDTH, foreground=False)[0]
    assert bare.read_mask().all()
    seen = whole.read_mask()
    assert not seen.all()
    assert np.array_equal(whole.read_depth()[seen], bare.read_depth()[seen])


def test_motion_between_samples(session: opencl.Session) -> None:
    """Poses and times of the samples are all that `Street.motion` asks for."""
    street = Street.generate(0)
    cur, after = street_clip(street, 2, HEIGHT, WIDTH)
    poses = invert(cur.world_from_cam), invert(after.world_from_cam)
    displacement = street.motion(*poses, cur.K, HEIGHT, WIDTH, cur.timestamp, after.timestamp)
    road = cur.read_labels()[0] == Label.ROAD
    ahead = after.world_from_cam[2, 3] - cur.world_from_cam[2, 3]
    np.testing.assert_allclose(displacement[2][road].mean(), -ahead, rtol=0.1)


def test_stereo_finds_the_depth(session: opencl.Session) -> None:
    """The pair is textured and rectified: semi-global matching gets its depth."""
    sample = street_clip(Street.generate(0), 1, 128, 416, samples=2)[0]
    right = sample.right
    found = stereo_depth(sample.read_image(), right.read_image(), sample.K, right.right_from_left)
    truth = sample.read_depth()
    near = (truth < 25) & (np.arange(416) > 64)
    assert near.mean() > 0.4
    assert np.median(np.abs(found / truth - 1)[near]) < 0.03


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "`frames` must be a positive integer, got 0"),
        ({"height": 0}, "`height` must be a positive integer, got 0"),
        ({"samples": 1.5}, "`samples` must be a positive integer, got 1.5"),
        ({"fps": 0.0}, "`fps` must be positive and finite, got 0.0"),
        ({"baseline": float("inf")}, "`baseline` must be positive and finite, got inf"),
        ({"start": float("nan")}, "`start` must be finite, got nan"),
    ],
)
def test_refuses(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        street_clip(Street.generate(0), **({"frames": 1, "height": 8, "width": 8} | changes))
