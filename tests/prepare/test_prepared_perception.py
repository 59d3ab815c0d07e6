"""vestcl.prepare.perception: prepared clips in place of recorded ones."""

from pathlib import Path

import numpy as np
import pytest

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric import forecast_frames
from vestcl.forecasting.peer import forecast_frames as peer_frames
from vestcl.forecasting.views import parse_views
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork
from vestcl.prepare.clip import EightBitPerception, prepare_clip
from vestcl.prepare.perception import PreparedPerception, PreparedSequence, as_clip
from vestcl.prepare.prepared import PreparedClip
from vestcl.scene.inputs import Inputs

SIZE = 48, 160


@pytest.fixture(scope="module")
def street() -> Clip:
    return street_clip(Street.generate(3), 4, *SIZE, samples=1)


@pytest.fixture(scope="module")
def sequence(street: Clip, tmp_path_factory: pytest.TempPathFactory) -> PreparedSequence:
    folder = tmp_path_factory.mktemp("prepared") / "street"
    prepare_clip(street, folder)
    return as_clip(PreparedClip.open(folder))


def test_its_frames_are_the_clips(street: Clip, sequence: PreparedSequence) -> None:
    assert (sequence.name, sequence.kind, len(sequence)) == (street.name, street.kind, len(street))
    assert sequence.interval == pytest.approx(street.interval) and np.array_equal(sequence.positions, street.positions)
    for own, recorded in zip(sequence, street, strict=True):
        assert own.name == recorded.name and own.right is not None and recorded.right is not None
        assert own.world_from_cam is not None and recorded.world_from_cam is not None
        assert np.array_equal(own.K, recorded.K) and np.array_equal(own.world_from_cam, recorded.world_from_cam)
        assert np.array_equal(own.right.right_from_left, recorded.right.right_from_left)
        for pair in ((own, recorded), (own.right, recorded.right)):
            one, other = (camera.read_image() for camera in pair)
            assert one.shape == (3, *SIZE) and np.abs(one - other).max() <= 0.5 / 255 + 1e-6
    half = sequence.resized(24, 80)
    assert isinstance(half, PreparedSequence) and half.prepared is sequence.prepared
    assert half[0].read_image().shape == (3, 24, 80)


def test_nothing_is_preprocessed_again(street: Clip, sequence: PreparedSequence) -> None:
    perception, wanted = PreparedPerception(sequence), EightBitPerception(street)
    for index in (1, 2):
        seen, original = perception.seen(index), wanted.seen(index)
        assert np.array_equal(seen.layers.depth, original.layers.depth)
        assert np.array_equal(seen.layers.mask, original.layers.mask)
        assert np.array_equal(perception.moving(index).instances, wanted.moving(index).instances)
        assert np.array_equal(perception.mask(index), original.layers.mask)
        assert np.array_equal(perception.raw_depth(index), original.layers.depth)
        assert np.array_equal(perception.prev_from_cur(index), wanted.prev_from_cur(index))
        np.testing.assert_allclose(seen.velocity, original.velocity, atol=0.01)
    with pytest.raises(ValueError, match="`index` must be 1 or more"):
        perception.prev_from_cur(0)
    views = parse_views(("source", "right"), street[2])
    made, original_made = (forecast_frames(each, 2, 1, views).frames[0] for each in (perception, wanted))
    for view in ("source", "right"):
        assert np.abs(made[view].image - original_made[view].image).mean() < 0.002


def test_the_right_camera_is_for_judging_only(sequence: PreparedSequence) -> None:
    """The learned baseline sees the clip's frames again: with their depth, not with their pairs."""
    perception = PreparedPerception(sequence)
    assert all(sample.right is None for sample in perception.clip)
    assert np.array_equal(perception.clip[2].read_depth(), perception.seen(2).layers.depth)
    assert not perception.clip[2].read_ego_vehicle().any()
    flow = VoxelFlowNetwork(blocks=[(4, 8), (1, 4)]).eval()
    views = parse_views(("right",), sequence[2])
    assert peer_frames(perception, flow, 2, 1, views).frames[0]["right"].image.shape == (3, *SIZE)


def test_a_cache_lists_its_inputs(sequence: PreparedSequence, street: Clip, tmp_path: Path) -> None:
    assert sequence.prepared is not None
    assert sequence.prepared.inputs == Inputs("the street itself, true", "labels", "optical flow and depth", "regions")
    settings = Inputs("the estimator a", "the classes of b", "optical flow and depth", "lama:c")
    prepare_clip(street[:2], tmp_path, settings)
    assert PreparedClip.open(tmp_path).inputs == settings
    text = (tmp_path / "clip.json").read_text().replace('"stereo": false', '"stereo": "no"')
    (tmp_path / "clip.json").write_text(text)
    with pytest.raises(ValueError, match="is damaged"):
        PreparedClip.open(tmp_path)
    for wrong in ({"depth": "a"}, {**settings.as_entries(), "stereo": 1}, None):
        with pytest.raises(ValueError, match="`inputs` must have depth, masks, motion, inpainting, stereo, got"):
            Inputs.read(wrong)
