"""The command line: `vestcl devices`, `doctor`, `demo` and `bench`. Whatever imports torch is imported late."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vestcl import __version__, doctor, runtime


@dataclass(frozen=True)
class Devices:
    """List the OpenCL devices of this machine."""

    def run(self) -> int:
        """Print the table."""
        used = runtime.select()
        table = Table("", "index", box=box.SIMPLE, padding=0)
        table.add_column("device, platform, driver", overflow="fold")
        for heading in ("type", "units", "GiB", "local KiB", "float64", "OpenCL"):
            table.add_column(heading)
        for info in runtime.devices():
            table.add_row(
                *("*" if info == used else "", info.index),
                Text(f"{info.name}\n{info.platform} {info.driver.split(' / ')[-1]}"),
                *(info.kind, str(info.compute_units), f"{info.memory_gib:.1f}", f"{info.local_memory_kib:.0f}"),
                *("yes" if info.float64 else "no", info.version.split()[1]),
            )
        console = Console()
        console.print(table)
        console.print("* is in use; VESTCL_DEVICE (an index or a part of a name) chooses another")
        return 0


@dataclass(frozen=True)
class Doctor:
    """Try every OpenCL device, each in a process of its own, and tell the remedy for what does not work."""

    timeout: float = 120.0
    """Seconds that a device may take."""

    def run(self) -> int:
        """Print what works; 0 if vestcl's default device does, else 1."""
        console = Console()
        with console.status("trying every OpenCL device"):
            report = doctor.examine(self.timeout)
        table = Table("", "index", "device, platform", *doctor.STEPS, box=box.SIMPLE, padding=0)
        for device in report.devices:
            marks = {step.name: "[green]yes[/]" if step.passed else "[red]no[/]" for step in device.steps}
            used = "*" if device.info.index == report.default else ""
            name = Text(f"{device.info.name}\n{device.info.platform}")
            table.add_row(used, device.info.index, name, *(marks.get(step, "-") for step in doctor.STEPS))
        if report.devices:
            console.print(table)
        for device in report.devices:
            for note in device.notes:
                console.print(Text(f"{device.info.index} {note}"), soft_wrap=True)
        for note in report.notes:
            console.print(Text(note), soft_wrap=True)
        console.print("[green]vestcl's device works[/]" if report.works else "[red]vestcl's device does not work[/]")
        others = [device.info.index for device in report.devices if device.works]
        if others and not report.works:
            console.print(f"another one does: VESTCL_DEVICE={others[0]}")
        return 0 if report.works else 1


@dataclass(frozen=True)
class Demo:
    """Render a procedural street, forecast it and show it from another camera."""

    out: Path = Path("out")
    """Folder for the pictures."""
    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    seed: int = 0
    """Which street."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""

    def run(self) -> int:
        """Write the pictures."""
        from vestcl import demo

        with runtime.use(self.device):
            demo.run(self.out, self.height, self.width, self.seed)
        return 0


@dataclass(frozen=True)
class Bench:
    """Time an operator on an OpenCL device: `vestcl bench splat`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; what a user can put right is told in one line, with exit code 2.

    Args:
        arguments: the command line; None takes the process's own.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if arguments == ["--version"]:
            print(f"vestcl {__version__}")
            return 0
        if arguments[:1] == ["bench"]:
            return _bench(arguments[1:])
        return _command(arguments)
    except (runtime.DeviceError, ValueError) as error:
        Console(stderr=True).print(Text(f"error: {error}", style="red"), soft_wrap=True)
        return 2


def _command(arguments: Sequence[str]) -> int:
    commands: dict[str, Callable[..., Any]] = {"devices": Devices, "doctor": Doctor, "demo": Demo, "bench": Bench}
    about = "Differentiable point splatting in OpenCL. `vestcl --version` tells the version."
    command = tyro.extras.subcommand_cli_from_dict(commands, prog="vestcl", description=about, args=arguments)
    return int(command.run())


def _bench(arguments: Sequence[str]) -> int:
    from vestcl.bench import splat

    config = tyro.extras.subcommand_cli_from_dict({"splat": splat.SplatBench}, prog="vestcl bench", args=arguments)
    splat.main(config)
    return 0
