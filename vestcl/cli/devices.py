"""What `vestcl devices` and `vestcl doctor` print."""

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vestcl import doctor, opencl
from vestcl.cli.commands import Devices, Doctor

#: What commands set by themselves, and programs have to.
PROGRAMS = (
    "in programs of your own set OMP_WAIT_POLICY=passive before torch is imported: else its threads keep cores busy "
    "that OpenCL needs (commands do so themselves; --threads N limits all)"
)


def run(options: Devices) -> int:
    """Print the table."""
    used = opencl.select()
    table = Table("", "index", box=box.SIMPLE, padding=0)
    table.add_column("device, platform, driver", overflow="fold")
    for heading in ("type", "units", "GiB", "local KiB", "float64", "OpenCL"):
        table.add_column(heading)
    for info in opencl.devices():
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


def run_doctor(options: Doctor) -> int:
    """Print what works; 0 if vestcl's default device does, else 1."""
    console = Console()
    with console.status("trying every OpenCL device"):
        report = doctor.examine(options.timeout)
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
    console.print(Text(PROGRAMS), soft_wrap=True)
    return 0 if report.works else 1
