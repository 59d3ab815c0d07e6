"""vestcl.models.networks.voxel_flow: that the peer is the published network in size and shape, and computes what it
should."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from vestcl.models.networks import voxel_flow
from vestcl.models.networks.voxel_flow import KEY, VoxelFlowBlock, VoxelFlowNetwork, warp


def frames(batch: int = 1, height: int = 32, width: int = 48) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.rand(batch, 3, height, width), torch.rand(batch, 3, height, width)


def test_it_has_the_published_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in VoxelFlowNetwork().parameters()) == 3_559_930


def test_two_frames_give_a_third(monkeypatch: pytest.MonkeyPatch) -> None:
    """All nine blocks run, once each, and every weight but the router's takes part."""
    calls = []
    whole = VoxelFlowBlock.forward

    def counted(self, *arguments):
        calls.append(self.scale)
        return whole(self, *arguments)

    monkeypatch.setattr(VoxelFlowBlock, "forward", counted)
    network = VoxelFlowNetwork()
    image = network(*frames(2))
    assert image.shape == (2, 3, 32, 48) and image.min() >= 0 and image.max() <= 1
    assert calls == list(voxel_flow.SCALES)
    image.sum().backward()
    silent = {name.split(".")[0] for name, p in network.named_parameters() if p.grad is None or not p.grad.any()}
    assert silent == {"router"}


def test_without_a_correction_it_is_the_mean_of_both() -> None:
    network = VoxelFlowNetwork()
    for block in network.blocks:
        torch.nn.init.zeros_(block.out.weight)
        torch.nn.init.zeros_(block.out.bias)
    first, second = frames()
    torch.testing.assert_close(network(first, second), (first + second) / 2)


def test_a_constant_flow_and_a_sure_mask_shift_one_frame() -> None:
    """Only each block's bias acts: nine times a ninth of 2 px to the right in frame 1, and a mask for frame 1."""
    network = VoxelFlowNetwork()
    for block in network.blocks:
        torch.nn.init.zeros_(block.out.weight)
        with torch.no_grad():
            block.out.bias.copy_(torch.tensor([0, 0, 2 / 9, 0, -10.0]))
    first, second = frames()
    torch.testing.assert_close(network(first, second)[..., :-2], second[..., 2:], rtol=0, atol=1e-4)


def test_routing_runs_what_it_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each scene of a batch gets what its own blocks give, whatever the others take; unused blocks do not run."""
    calls = []
    whole = VoxelFlowBlock.forward

    def counted(self, *arguments):
        calls.append(list(network.blocks).index(self))
        return whole(self, *arguments)

    monkeypatch.setattr(VoxelFlowBlock, "forward", counted)
    network = VoxelFlowNetwork(routing=True)
    first, second = frames(2)
    draws = torch.zeros(2, 9)
    draws[0, [0, 8]] = draws[1, 4] = 1
    monkeypatch.setattr(torch, "bernoulli", lambda _: draws)
    both = network(first, second)
    assert calls == [0, 4, 8]
    for scene in range(2):
        monkeypatch.setattr(torch, "bernoulli", lambda _, own=scene: draws[own : own + 1])
        single = network(first[scene : scene + 1], second[scene : scene + 1])
        torch.testing.assert_close(both[scene : scene + 1], single)
    assert calls == [0, 4, 8, 0, 8, 4]


def test_routing_keeps_to_its_budget() -> None:
    scenes = 400
    with torch.no_grad():
        count = VoxelFlowNetwork(routing=True)._draw(*frames(scenes, 16, 16)).sum(dim=1).double()
    assert abs(count.mean() - 4.5) < 4 * 1.5 / scenes**0.5, "four deviations of a mean over nine fair coins"


def test_warp_reads_where_the_flow_points() -> None:
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    flow = torch.zeros(1, 2, 3, 4)
    flow[:, 0], flow[:, 1] = 0.5, 1
    wanted = torch.tensor([[4.5, 5.5, 6.5, 7], [8.5, 9.5, 10.5, 11], [8.5, 9.5, 10.5, 11]])
    torch.testing.assert_close(warp(image, flow)[0, 0], wanted)


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ((1, 3, 32, 40), (1, 3, 32, 40), "first"),
        ((1, 3, 32, 48), (1, 4, 32, 48), "second"),
        ((2, 3, 32, 48), (1, 3, 32, 48), "second"),
        ((3, 32, 48), (3, 32, 48), "first"),
    ],
)
def test_other_shapes_are_refused(first: tuple[int, ...], second: tuple[int, ...], name: str) -> None:
    with pytest.raises(ValueError, match=rf"`{name}` must be .* got \["):
        VoxelFlowNetwork()(torch.zeros(first), torch.zeros(second))


def test_each_block_corrects_the_next_frame_and_the_last_one_is_the_answer() -> None:
    network, (first, second) = VoxelFlowNetwork(blocks=[(2, 8), (1, 4)]), frames()
    images = list(network.corrected(first, second))
    assert len(images) == 2 and not torch.equal(images[0], images[1])
    assert torch.equal(images[1], network(first, second))


def test_a_saved_network_is_the_same(tmp_path: Path) -> None:
    network, (first, second) = VoxelFlowNetwork(blocks=[(4, 8), (1, 4)]).eval(), frames()
    network.save(tmp_path / "deep" / "peer.safetensors")
    loaded = VoxelFlowNetwork.load(tmp_path / "deep" / "peer.safetensors")
    assert loaded.sizes == ((4, 8), (1, 4)) and not loaded.routes and not loaded.training
    assert torch.equal(loaded(first, second), network(first, second))


def test_files_that_hold_no_such_network(tmp_path: Path) -> None:
    path = tmp_path / "peer.safetensors"
    with pytest.raises(FileNotFoundError, match=r"no DMVFN-shaped network at .*: `python -m train.peer` writes one"):
        VoxelFlowNetwork.load(path)
    path.write_bytes(b"no weights")
    with pytest.raises(ValueError, match="`path` must hold a DMVFN-shaped network"):
        VoxelFlowNetwork.load(path)
    weights = VoxelFlowNetwork(blocks=[(1, 4)]).state_dict()
    save_file(weights, path)
    with pytest.raises(ValueError, match=r"must hold a DMVFN-shaped network, .*voxel_flow"):
        VoxelFlowNetwork.load(path)
    built = {KEY: '{"routing": false, "blocks": [[1, 8]]}'}
    save_file(weights, path, metadata=built)
    with pytest.raises(ValueError, match="must hold the weights of its network"):
        VoxelFlowNetwork.load(path)
    broken = VoxelFlowNetwork(blocks=[(1, 8)])
    with torch.no_grad():
        broken.blocks[0].out.bias.fill_(torch.nan)
    broken.save(path)
    with pytest.raises(ValueError, match="must hold finite weights, got NaN"):
        VoxelFlowNetwork.load(path)


@pytest.mark.parametrize("blocks", [[], [(3, 8)], [(1, 6)], [(1, 0)]])
def test_blocks_that_cannot_be(blocks: list[tuple[int, int]]) -> None:
    with pytest.raises(ValueError, match="`blocks` must be pairs of a scale 1, 2 or 4 and a multiple of 4"):
        VoxelFlowNetwork(blocks=blocks)
