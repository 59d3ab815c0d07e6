"""What a forecaster remembers of frames: content decides, of frames and of weights, wherever they lie in memory."""

import copy
import dataclasses
import io
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, TINY, camera, frame, measured, stir
from torch import nn

from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.fast import accelerate
from vestcl.models.inference.skipping import count_skips
from vestcl.models.steps.frames import EncodedFrame
from vestcl.models.steps.memory import EncodedFrames
from vestcl.scene.layers import LayerBatch

HEIGHT, WIDTH = 32, 64
PLANES = LayerBatch._fields


def model() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SMALL)).eval()


def frames(seed: int = 1) -> tuple[LayerBatch, LayerBatch]:
    torch.manual_seed(seed)
    return frame(1, HEIGHT, WIDTH), frame(1, HEIGHT, WIDTH)


def run(network: Forecaster, prev: LayerBatch, cur: LayerBatch) -> list[torch.Tensor]:
    """All that a forecast shows."""
    prior = measured(1, HEIGHT, WIDTH, cur=(0.1, 0, -0.8)) if network.config.start == "prior" else None
    with torch.inference_mode():
        return [plane.clone() for plane in network(prev, cur, camera(1, HEIGHT, WIDTH), prior=prior).views[0]]


def fresh(network: Forecaster, prev: LayerBatch, cur: LayerBatch) -> list[torch.Tensor]:
    """The same by a copy that remembers nothing."""
    forgetful = copy.deepcopy(network)
    forgetful.options = dataclasses.replace(network.options, seen=False)
    return run(forgetful, prev, cur)


def equal(one: list[torch.Tensor], other: list[torch.Tensor]) -> bool:
    return all(map(torch.equal, one, other))


# ---------------------------------------------------------------- frames


def refill_copy(tensor: torch.Tensor, by: torch.Tensor) -> None:
    tensor.copy_(by)


def refill_data(tensor: torch.Tensor, by: torch.Tensor) -> None:
    tensor.data[...] = by


def refill_numpy(tensor: torch.Tensor, by: torch.Tensor) -> None:
    np.copyto(tensor.numpy(), by.numpy())


@pytest.mark.parametrize("refill", [refill_copy, refill_data, refill_numpy])
@pytest.mark.parametrize("inference", [False, True])
def test_buffers_that_are_refilled_are_new_frames(refill: Callable[..., None], inference: bool) -> None:
    """As a camera's driver does it: the frame before moves into one pair of buffers, the new frame into the other."""
    network, (first, second), (third, _) = model(), frames(), frames(2)
    with torch.inference_mode(inference):
        prev, cur = (LayerBatch(*(plane.clone() for plane in each)) for each in (first, second))
        run(network, prev, cur)
        for buffers, content in ((prev, second), (cur, third)):
            for buffer, plane in zip(buffers, content, strict=True):
                refill(buffer, plane)
        with count_skips() as tally:
            got = run(network, prev, cur)
    assert tally.counts["seen"] == (1, 2, "frames"), "the frame before was known, by its content"
    assert equal(got, fresh(network, second, third))


@pytest.mark.parametrize("plane", PLANES)
def test_every_plane_counts(plane: str) -> None:
    """One number of one plane, where the quick look at some of the pixels misses it."""
    network, (prev, cur) = model(), frames()
    run(network, prev, cur)
    getattr(cur, plane)[0, 0, 7, 9].add_(1.0).remainder_(2.0)
    assert equal(run(network, prev, cur), fresh(network, prev, cur))


def test_a_frame_that_comes_again_has_its_own_depth() -> None:
    """What is remembered of it was written over since, where it lay."""
    network, (prev, cur), (other, _) = model(), frames(), frames(2)
    kept = LayerBatch(*(plane.clone() for plane in cur))
    wanted = run(network, prev, cur)
    for buffer, plane in zip(cur, other, strict=True):
        buffer.copy_(plane)
    with count_skips() as tally:
        assert equal(run(network, prev, kept), wanted)
    assert tally.counts["seen"] == (2, 2, "frames")


def test_another_size_or_batch_is_another_frame() -> None:
    network, (prev, cur) = model(), frames()
    run(network, prev, cur)
    narrow = LayerBatch(*(plane[..., : WIDTH - 16] for plane in cur))
    twice = LayerBatch(*(plane.repeat(2, 1, 1, 1) for plane in cur))
    with torch.no_grad(), count_skips() as tally:
        for each in (narrow, twice):
            assert network.encode(each).features.shape[::3] == each.image.shape[::3]
    assert tally.counts["seen"].skipped == 0


def test_what_a_forecast_gives_may_be_written_to() -> None:
    network, pair = model(), frames()
    prior, K = measured(1, HEIGHT, WIDTH), camera(1, HEIGHT, WIDTH)

    def forecast() -> list[torch.Tensor]:
        step = network(*pair, K, prior=prior)
        motion = step.motion
        return [*step.views[0], *motion.points, motion.flow0, motion.start, motion.objects.flow, step.future_from_cur]

    with torch.no_grad():
        wanted = [tensor.clone() for tensor in forecast()]
        for tensor in forecast():
            tensor.fill_(torch.nan)
        assert equal(forecast(), wanted)


# ---------------------------------------------------------------- weights


def optimise(network: Forecaster) -> None:
    """A step of Adam."""
    adam = torch.optim.Adam(network.encoder.parameters(), 0.1)
    network.encoder(torch.rand(1, 3, 16, 16)).square().sum().backward()
    adam.step()


def write_data(network: Forecaster) -> None:
    network.encoder.out.bias.data += 1


def write_numpy(network: Forecaster) -> None:
    network.encoder.out.bias.detach().numpy()[0] += 1


def set_data(network: Forecaster) -> None:
    network.encoder.out.bias.data = network.encoder.out.bias.data + 1


def replace_parameter(network: Forecaster) -> None:
    network.encoder.out.bias = nn.Parameter(network.encoder.out.bias.detach() + 1)


def load(network: Forecaster) -> None:
    state = network.state_dict()
    network.load_state_dict(state | {"encoder.out.bias": state["encoder.out.bias"] + 1})


def load_assigned(network: Forecaster) -> None:
    state = network.state_dict()
    network.load_state_dict(state | {"encoder.out.bias": state["encoder.out.bias"] + 1}, assign=True)


def replace_encoder(network: Forecaster) -> None:
    network.encoder = Forecaster(SMALL).encoder


def write_ego_motion(network: Forecaster) -> None:
    """What EMF sees of a frame is remembered with it."""
    assert network.ego_motion is not None
    network.ego_motion.get_parameter("frame.0.weight").data *= 2


WAYS = [
    optimise, write_data, write_numpy, set_data, replace_parameter, load, load_assigned, replace_encoder,
    write_ego_motion,
]  # fmt: skip


@pytest.mark.parametrize("change", WAYS)
def test_weights_that_changed_in_any_way_count(change: Callable[[Forecaster], None]) -> None:
    network, pair = model(), frames()
    before = run(network, *pair)
    change(network)
    got = run(network, *pair)
    assert equal(got, fresh(network, *pair)) and not equal(got, before)


def test_weights_of_another_precision_count() -> None:
    network, pair = model(), frames()
    with torch.no_grad():
        single = network.encode(pair[0]).features.clone()
        network.double()
        doubles = LayerBatch(*(plane.double() for plane in pair[0]))
        assert network.encode(doubles).features.dtype == torch.float64
        network.float()
        assert torch.equal(network.encode(pair[0]).features, single)


def test_settings_count() -> None:
    network, pair = model(), frames()
    run(network, *pair)
    network.config = dataclasses.replace(network.config, fixed_depth=12.0)
    assert equal(run(network, *pair), fresh(network, *pair))
    network.options = dataclasses.replace(network.options, autocast="bfloat16")
    assert equal(run(network, *pair), fresh(network, *pair))
    network.options = dataclasses.replace(network.options, autocast=None)
    with torch.autocast("cpu", torch.bfloat16):
        around = run(network, *pair)
    assert equal(run(network, *pair), fresh(network, *pair)) and not equal(run(network, *pair), around)


def test_weights_that_were_made_for_inference_are_remembered() -> None:
    with torch.inference_mode():
        network = model()
    pair = frames()
    wanted = run(network, *pair)
    with count_skips() as tally:
        assert equal(run(network, *pair), wanted)
    assert tally.counts["seen"] == (2, 2, "frames")


@pytest.mark.parametrize("change", WAYS)
def test_an_accelerated_copys_weights_count(change: Callable[[Forecaster], None]) -> None:
    """Of its encoder as of the plain model's."""
    plain = model()
    quick, pair = accelerate(plain), frames()
    before = run(quick, *pair)
    quick.encoder.requires_grad_(True)
    change(quick)
    got = run(quick, *pair)
    assert equal(got, fresh(quick, *pair)) and not equal(got, before)


@pytest.mark.parametrize("write", [write_data, write_numpy, set_data, replace_parameter, load_assigned])
def test_shared_convolutions_have_their_blocks_weights(write: Callable[..., None]) -> None:
    """Of object motion, whose blocks share one convolution over the frames."""
    torch.manual_seed(0)
    plain, pair = stir(Forecaster(TINY)).eval(), frames()
    quick = accelerate(plain)
    run(quick, *pair)
    names = [name for name, _ in plain.named_parameters() if name.endswith(("full_in.weight", "shrunk_in.bias"))]
    for network in (plain, quick):
        for name in names:
            write_any(network, name, write)
    wanted, got = run(plain, *pair), run(quick, *pair)
    assert all(torch.allclose(one, other, rtol=1e-4, atol=1e-4) for one, other in zip(got, wanted, strict=True))


def write_any(network: Forecaster, name: str, write: Callable[..., None]) -> None:
    """Double a parameter in the way that ``write`` changes the encoder's bias."""
    owner, _, kind = name.rpartition(".")
    module, weight = network.get_submodule(owner), network.get_parameter(name)
    if write is write_data:
        weight.data *= 2
    elif write is write_numpy:
        weight.detach().numpy()[...] *= 2
    elif write is set_data:
        weight.data = weight.data * 2
    elif write is replace_parameter:
        setattr(module, kind, nn.Parameter(weight.detach() * 2))
    else:
        network.load_state_dict(network.state_dict() | {name: weight.detach() * 2}, assign=True)


# ---------------------------------------------------------------- copies, threads


def test_copies_begin_with_an_empty_memory() -> None:
    network, pair = model(), frames()
    wanted = run(network, *pair)
    file = io.BytesIO()
    torch.save(network, file)
    file.seek(0)
    for other in (copy.deepcopy(network), torch.load(file, weights_only=False)):
        with count_skips() as tally:
            assert equal(run(other, *pair), wanted)
        assert tally.counts["seen"] == (0, 2, "frames")


def test_each_thread_keeps_two_frames() -> None:
    """In turns with other threads each finds its own frames again; beyond eight frames the oldest go."""
    memory, images = (
        EncodedFrames(),
        [LayerBatch(*(torch.full((1, 1, 2, 2), float(number)),) * 5) for number in range(12)],
    )

    def keep(*numbers: int) -> None:
        state = memory.state("settings", [torch.ones(2)])
        for number in numbers:
            memory.keep(state, images[number], EncodedFrame(images[number], torch.ones(1), torch.ones(1), True))

    def known() -> list[int]:
        state = memory.state("settings", [torch.ones(2)])
        return [number for number, layers in enumerate(images) if memory.find(state, layers) is not None]

    keep(0, 1)
    end = threading.Barrier(4)
    threads = [threading.Thread(target=lambda n=n: (keep(n, n + 1), end.wait())) for n in (2, 4, 6)]
    for thread in threads:  # all run until the end, so that each has its own number
        thread.start()
        while len(known()) < 2 * (2 + threads.index(thread)):
            time.sleep(0.001)
    keep(8)
    assert known() == [*range(1, 9)], "the oldest of the thread's own goes"
    end.wait()
    for thread in threads:
        thread.join()
    other = threading.Thread(target=keep, args=(9, 10))
    other.start()
    other.join()
    assert known()[-2:] == [9, 10] and 6 <= len(known()) <= 8, "the oldest of all go"


def test_nothing_is_remembered_where_nothing_is_skipped() -> None:
    network, pair = model(), frames()
    network.options = network.options.without_skips()
    with count_skips() as tally:
        run(network, *pair)
        run(network, *pair)
    assert "seen" not in tally.counts
