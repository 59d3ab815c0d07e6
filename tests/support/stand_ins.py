"""Modules in place of others, where the real ones take too long or are not what is tested."""

import sys
import types

import pytest


def put_module(monkeypatch: pytest.MonkeyPatch, name: str, **members: object) -> None:
    """A stand-in for module ``name``, wherever it is imported from."""
    module = types.ModuleType(name)
    vars(module).update(members)
    monkeypatch.setitem(sys.modules, name, module)
    package, _, stem = name.rpartition(".")
    monkeypatch.setattr(sys.modules[package], stem, module, raising=False)
