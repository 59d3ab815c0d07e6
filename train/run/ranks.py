"""The processes that train together: started by torchrun, or a single one."""

import gc
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Final

import torch
from torch import distributed
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from vestcl import opencl

#: A process that does not answer for so long is given up, and torchrun starts all of them again.
PATIENCE: Final = timedelta(minutes=10)

#: The largest TCP port.
_PORTS: Final = 65_535

#: What gloo's errors, plain RuntimeErrors, have in their text when another process has ended.
_GONE: Final = re.compile(r"gloo|connection (closed|reset|refused)|broken pipe|timed? ?out", re.IGNORECASE)


class LostProcessError(RuntimeError):
    """Another process of the run could not be reached, or has ended."""


@dataclass(frozen=True)
class Ranks:
    """This process among all of them."""

    rank: int = 0
    world: int = 1
    local: int = 0
    """This process among those of its machine."""

    @classmethod
    def join(cls) -> "Ranks":
        """The rank that torchrun's environment gives, once all processes have met (gloo); rank 0 of 1 without it.

        Raises:
            ValueError: a variable that is absent or no such number; the message names it.
            LostProcessError: the other processes can't be reached.
        """
        rank, world, local = _variable("RANK", 0), _variable("WORLD_SIZE", 1, least=1), local_rank()
        if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
            return cls()
        if rank >= world:
            raise ValueError(f"RANK must be below WORLD_SIZE, {world}, got {rank}")
        if not distributed.is_initialized():
            _check_address()
            with lost_processes_named():
                store, rank, world = next(rendezvous("env://", timeout=PATIENCE))
                if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":  # it has the lost ones' addresses
                    store = PrefixStore(f"start {_restarts()}", store)
                distributed.init_process_group("gloo", timeout=PATIENCE, store=store, rank=rank, world_size=world)
        return cls(distributed.get_rank(), distributed.get_world_size(), local)

    @property
    def first(self) -> bool:
        """Whether this process writes and prints."""
        return self.rank == 0

    @property
    def restarted(self) -> bool:
        """Whether torchrun has started the processes again after one was lost; all get the same answer.

        A host that took a lost one's place counts from 0.
        """
        return self.any(_restarts() > 0)

    def any(self, flag: bool) -> bool:
        """Whether it is true in any process; all get the same answer."""
        if self.world == 1:
            return flag
        total = torch.tensor(int(flag))
        distributed.all_reduce(total, distributed.ReduceOp.MAX)
        return bool(total)

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Mean of each value over the processes, which all have the same names."""
        if self.world == 1:
            return values
        total = torch.tensor(list(values.values()), dtype=torch.float64) / self.world
        distributed.all_reduce(total)
        return dict(zip(values, total.tolist(), strict=True))

    def device(self) -> str | None:
        """The OpenCL device of this process: the machine's devices of the default's kind in turn, one each.

        Returns:
            Its index in `vestcl devices`; None is the default, where there is but one of its kind.
        """
        default = opencl.select()
        same = [each.index for each in opencl.devices() if each.kind == default.kind != "CPU"]
        return same[self.local % len(same)] if same else None

    def leave(self) -> None:
        """Say goodbye to the others.

        What holds the group in a cycle, as DistributedDataParallel does, goes first: a thread of the group that is
        still there when Python ends may abort the process.
        """
        if distributed.is_initialized():
            gc.collect()
            distributed.destroy_process_group()


@contextmanager
def lost_processes_named() -> Iterator[None]:
    """Inside the ``with`` block torch's errors about other processes become LostProcessErrors of one line."""
    try:
        yield
    except RuntimeError as error:
        is_gloos = type(error) is RuntimeError and _GONE.search(str(error))
        if not is_gloos and not isinstance(error, distributed.DistError):
            raise
        reason = str(error).partition("\n")[0]
        raise LostProcessError(f"another process of this run can't be reached or has ended ({reason})") from error


def local_rank() -> int:
    """This process among those of its machine, by torchrun's environment; 0 without it.

    Raises:
        ValueError: LOCAL_RANK is no such number.
    """
    return _variable("LOCAL_RANK", 0)


def _restarts() -> int:
    """How often torchrun has started the processes again."""
    return _variable("TORCHELASTIC_RESTART_COUNT", 0)


def _check_address() -> None:
    """Raises a ValueError where the address that processes meet at is not given."""
    if not os.environ.get("MASTER_ADDR"):
        raise ValueError("MASTER_ADDR must be set, to the first process's machine, where RANK and WORLD_SIZE are")
    if (port := _variable("MASTER_PORT", 0)) > _PORTS or "MASTER_PORT" not in os.environ:
        raise ValueError(f"MASTER_PORT must be set, to 0 ... {_PORTS}, where RANK and WORLD_SIZE are, got {port}")


def _variable(name: str, default: int, least: int = 0) -> int:
    """The whole number that the environment has as ``name``."""
    text = os.environ.get(name, str(default))
    if not re.fullmatch(r"[0-9]{1,9}", text) or int(text) < least:
        raise ValueError(f"{name} must be a whole number, {least} or more, as torchrun sets it, got {text[:40]!r}")
    return int(text)
