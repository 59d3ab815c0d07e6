"""The global random generators, as a checkpoint keeps them."""

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


def rng_state() -> dict[str, Any]:
    """The global generators of torch, NumPy and Python, in plain containers; `restore_rng` takes them."""
    state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002 - the one that others' code may use
    key = torch.from_numpy(state["state"]["key"].astype(np.int64))
    numpy_state = {**state, "state": {**state["state"], "key": key}}
    return {"torch": torch.get_rng_state(), "numpy": numpy_state, "python": random.getstate()}


def restore_rng(state: Mapping[str, Any]) -> None:
    """Set the generators to what `rng_state` gave."""
    inner = state["numpy"]["state"]
    torch.set_rng_state(state["torch"])
    key = inner["key"].numpy().astype(np.uint32)
    np.random.set_state({**state["numpy"], "state": {**inner, "key": key}})  # noqa: NPY002
    random.setstate(state["python"])
