"""The forecaster: which layer of which frame each network sees, and each point carries."""

import pytest
import torch
from forecaster_scenes import TINY, camera, pair_of, stir

from vestcl.models import EgoMotion, ObjectMotion, upsample_features
from vestcl.models.forecaster import Forecaster
from vestcl.models.steps.frames import grid_depth, grid_mean
from vestcl.scene.layers import LayerBatch

HEIGHT, WIDTH = 32, 48


def assert_close(got: torch.Tensor, wanted: torch.Tensor) -> None:
    """Convolutions round otherwise in batches of another size."""
    assert torch.allclose(got, wanted, atol=1e-5)


@pytest.fixture
def model() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(TINY)).eval()


@pytest.fixture
def pair() -> tuple[LayerBatch, LayerBatch]:
    """Both frames have foreground, each elsewhere; the inpainted layer there is black and 10 m behind."""
    prev, cur = pair_of(2, HEIGHT, WIDTH)
    return prev, LayerBatch(*(tensor.roll(17, dims=3) for tensor in cur))


def test_ego_motion_sees_the_inpainted_background(model: Forecaster, pair: tuple[LayerBatch, LayerBatch]) -> None:
    """F_bg, log D_bg and M of t-1 and of t; nothing that is only in front of the background moves the camera."""
    assert isinstance(model.ego_motion, EgoMotion)
    seen: list[torch.Tensor] = []
    model.ego_motion.frame.register_forward_hook(lambda _module, inputs, _output: seen.append(inputs[0]))
    with torch.no_grad():
        first = model(*pair, camera(2, HEIGHT, WIDTH)).motion
        for got, layers in zip(seen, pair, strict=True):
            features, depth, mask = got.split([4, 1, 1], dim=1)
            assert_close(features, model.encoder(layers.background_image))
            assert_close(depth, grid_depth(layers.background_depth).log())
            assert torch.equal(mask, grid_mean(layers.mask))
        hidden = pair[1].mask == 0
        car = torch.where(hidden, torch.rand_like(pair[1].image), pair[1].image)
        changed = pair[1]._replace(image=car, depth=torch.where(hidden, 3.0, pair[1].depth))
        second = model(pair[0], changed, camera(2, HEIGHT, WIDTH)).motion
    for one, other in zip((*first[0], *first[1]), (*second[0], *second[1]), strict=True):
        assert_close(one, other)


def test_object_motion_sees_the_frames_themselves(model: Forecaster, pair: tuple[LayerBatch, LayerBatch]) -> None:
    """F, D, M of t-1 and of t, in that order, and the rigid flow of both."""
    assert isinstance(model.object_motion, ObjectMotion)
    seen: list[torch.Tensor] = []
    model.object_motion.register_forward_pre_hook(lambda _module, inputs: seen.extend(inputs))
    with torch.no_grad():
        motion = model(*pair, camera(2, HEIGHT, WIDTH)).motion
        features = [upsample_features(model.encoder(layers.image), HEIGHT, WIDTH) for layers in pair]
    wanted = [*features, *(layers.depth for layers in pair), *(layers.mask for layers in pair), motion.flow0]
    assert len(seen) == len(wanted)
    for got, expected in zip(seen, wanted, strict=True):
        assert_close(got, expected)


def test_points_carry_what_their_own_layer_shows(model: Forecaster, pair: tuple[LayerBatch, LayerBatch]) -> None:
    """A pixel's point the frame's features and colour, one behind the foreground those of the inpainted background."""
    K = camera(2, HEIGHT, WIDTH)
    with torch.no_grad():
        prev, cur = (model.encode(layers) for layers in pair)
        clouds = model.lift(prev, cur, model.move(prev, cur, K), K)
        for cloud, layers in zip(clouds, pair, strict=True):
            for image, depth, chosen in (
                (layers.image, layers.depth, ~cloud.inpainted),
                (layers.background_image, layers.background_depth, cloud.inpainted),
            ):
                features = upsample_features(model.encoder(image), HEIGHT, WIDTH)
                where = layers.mask[:, 0] < 2 if image is layers.image else layers.mask[:, 0] == 0
                assert_close(cloud.features[chosen], features.permute(0, 2, 3, 1)[where])
                assert torch.equal(cloud.colour[chosen], image.permute(0, 2, 3, 1)[where])
                assert torch.equal(cloud.depth[chosen], depth[:, 0][where])
                assert torch.equal(cloud.points_xyz[chosen][:, 2], depth[:, 0][where])
