"""The processes that train together: started by torchrun, or one alone."""

import gc
import os
from dataclasses import dataclass
from datetime import timedelta
from typing import Final

import torch
from torch import distributed
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from vestcl import runtime

#: A process that does not answer for so long is given up, and torchrun starts all of them anew.
PATIENCE: Final = timedelta(minutes=10)


@dataclass(frozen=True)
class Ranks:
    """This process among all of them."""

    rank: int = 0
    world: int = 1
    local: int = 0
    """This process among those of its machine."""

    @classmethod
    def join(cls) -> "Ranks":
        """What torchrun's environment says, once all processes have met (gloo); alone without it."""
        if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
            return cls()
        if not distributed.is_initialized():
            store, rank, world = next(rendezvous("env://", timeout=PATIENCE))
            fresh = PrefixStore(f"start {_restarts()}", store)  # torchrun's has the lost ones' addresses
            distributed.init_process_group("gloo", timeout=PATIENCE, store=fresh, rank=rank, world_size=world)
        return cls(distributed.get_rank(), distributed.get_world_size(), int(os.environ.get("LOCAL_RANK", "0")))

    @property
    def first(self) -> bool:
        """Whether this process writes and prints."""
        return self.rank == 0

    @property
    def restarted(self) -> bool:
        """Whether torchrun has started the processes again after one was lost."""
        return _restarts() > 0

    def any(self, flag: bool) -> bool:
        """Whether it is true in any process; all get the same answer."""
        if self.world == 1:
            return flag
        told = torch.tensor(int(flag))
        distributed.all_reduce(told, distributed.ReduceOp.MAX)
        return bool(told)

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Of each value over the processes, which all have the same names."""
        if self.world == 1:
            return values
        told = torch.tensor(list(values.values()), dtype=torch.float64) / self.world
        distributed.all_reduce(told)
        return dict(zip(values, told.tolist(), strict=True))

    def device(self) -> str | None:
        """The OpenCL device of this process: the machine's devices of the default's kind in turn, one each.

        Returns:
            Its index in `vestcl devices`; None is the default, where there is but one of its kind.
        """
        default = runtime.select()
        alike = [each.index for each in runtime.devices() if each.kind == default.kind != "CPU"]
        return alike[self.local % len(alike)] if alike else None

    def leave(self) -> None:
        """Say goodbye to the others.

        What holds the group in a cycle, as DistributedDataParallel does, goes first: a thread of the group that is
        still there when Python ends may abort the process.
        """
        if distributed.is_initialized():
            gc.collect()
            distributed.destroy_process_group()


def _restarts() -> int:
    """How often torchrun has started the processes again."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
