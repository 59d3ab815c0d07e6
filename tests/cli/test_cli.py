"""The command line, called as a function; only what must not be imported is tested in a child."""

import subprocess
import sys
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import pytest
from stand_ins import put_module

from vestcl import __version__, doctor, opencl
from vestcl.cli import main as cli
from vestcl.io.labels import LabelKind


@pytest.fixture(autouse=True)
def _wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("VESTCL_DEVICE", raising=False)


def test_devices_marks_the_one_in_use(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for info in opencl.devices():
        monkeypatch.setenv("VESTCL_DEVICE", info.index)
        assert cli.main(["devices"]) == 0
        table = capsys.readouterr().out
        assert [line.split()[1] for line in table.splitlines() if line.startswith(" * ")] == [info.index]
        assert info.name in table
        assert info.platform in table


def test_devices_is_quick() -> None:
    code = "import sys; from vestcl.cli import main as cli; cli.main(['devices']); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_an_unknown_device_is_one_red_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VESTCL_DEVICE", "abacus")
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert cli.main(["devices"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("\x1b[31merror: VESTCL_DEVICE 'abacus' fits none of the OpenCL devices")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"vestcl {__version__}\n"


@pytest.mark.parametrize(("arguments", "code"), [("--help", 0), ("", 2), ("dance", 2), ("demo --seed x", 2)])
def test_help_and_mistakes(arguments: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments.split())
    assert caught.value.code == code
    assert "Traceback" not in "".join(capsys.readouterr())


def test_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    put_module(
        monkeypatch, "vestcl.cli.demo", run=lambda *arguments: calls.append((*arguments, opencl.current().info.index))
    )
    last = opencl.devices()[-1].index
    before = opencl.current()
    assert cli.main(["demo"]) == 0
    options = "--out x --height 8 --width 9 --seed 3 --quality fast --device"
    assert cli.main(["demo", *options.split(), last]) == 0
    assert cli.main(["demo", "--model", "geometric"]) == 0
    default, given, geometric = calls
    assert default == (Path("out"), 256, 832, 3, None, "balanced", before.info.index)
    assert given == (Path("x"), 8, 9, 3, None, "fast", last)
    assert geometric[4] == "geometric"
    assert opencl.current() is before


@pytest.mark.parametrize("kind", [ValueError, PermissionError, FileNotFoundError, opencl.DeviceError])
def test_what_a_user_can_put_right_is_one_line(
    kind: type[Exception], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*_: object) -> None:
        raise kind("`height` must be even, got 1")

    put_module(monkeypatch, "vestcl.cli.demo", run=run)
    assert cli.main(["demo", "--height", "1"]) == 2
    assert capsys.readouterr().err == "error: --height must be even, got 1\n"


def test_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class SplatBench:
        """Time splat."""

        points: int = 1000

    configs: list[object] = []
    put_module(monkeypatch, "vestcl.bench")
    put_module(monkeypatch, "vestcl.bench.splat")
    put_module(monkeypatch, "vestcl.bench.splat.bench", SplatBench=SplatBench, main=configs.append)
    assert cli.main(["bench", "splat"]) == 0
    assert cli.main(["bench", "splat", "--points", "5"]) == 0
    assert configs == [SplatBench(1000), SplatBench(5)]
    for name in ("vestcl.bench.forecast", "vestcl.bench.forecast.inpaint"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    for mistake in ([], ["abacus"], ["inpaint"]):  # this stand-in has no bench of that name
        with pytest.raises(SystemExit):
            cli.main(["bench", *mistake])


def test_a_bench_does_not_need_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class NetworkBench:
        """Time a network."""

        width: int = 832

    configs: list[object] = []
    put_module(monkeypatch, "vestcl.bench")
    put_module(monkeypatch, "vestcl.bench.network")
    put_module(monkeypatch, "vestcl.bench.network.bench", NetworkBench=NetworkBench, main=configs.append)
    assert cli.main(["bench", "network", "--width", "9"]) == 0
    assert configs == [NetworkBench(9)]


def test_a_broken_bench_blocks_no_other(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the list of all benches it is left out, and it says what is wrong when it is asked for."""

    @dataclass(frozen=True)
    class SplatBench:
        """Time splat."""

    def broken(path: str) -> object:
        if path == "vestcl.bench.splat.bench":
            return SimpleNamespace(SplatBench=SplatBench)
        if path == "vestcl.bench.pareto.bench":
            return SimpleNamespace()
        if path == "vestcl.bench.splat.operators":
            raise ModuleNotFoundError("No module named 'abacus'", name="abacus")
        raise ModuleNotFoundError(path, name=path)

    monkeypatch.setattr(cli, "import_module", broken)
    with pytest.raises(SystemExit):
        cli.main(["bench", "--help"])
    out, err = capsys.readouterr()
    assert "Time splat" in out
    lines = err.splitlines()
    assert len(lines) == 2 and "operators is left out" in lines[0] and "abacus" in lines[0] and "pareto" in lines[1]
    with pytest.raises(AttributeError, match="ParetoBench"):
        cli.main(["bench", "pareto"])


def test_a_bench_with_a_hyphen_and_an_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class TrainStepBench:
        """Time a training step."""

        code: int = 1

    put_module(monkeypatch, "vestcl.bench")
    put_module(monkeypatch, "vestcl.bench.network")
    put_module(
        monkeypatch, "vestcl.bench.network.train_step", TrainStepBench=TrainStepBench, main=lambda config: config.code
    )
    assert cli.main(["bench", "train-step"]) == 1
    assert cli.main(["bench", "train-step", "--code", "0"]) == 0


def test_every_bench_that_there_is_has_its_settings() -> None:
    folder = Path(cli.__file__).parents[1] / "bench"
    there = {file.stem.replace("_", "-") for file in folder.glob("[!_]*.py")}
    assert there <= set(cli._BENCHES)
    found = cli._benches(sorted(there), asked=True)
    assert set(found) == there
    assert all(callable(module.main) and is_dataclass(kind) for module, kind in found.values())


def test_a_bench_that_lacks_a_package_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacks(name: str) -> None:
        raise ModuleNotFoundError("No module named 'abacus'", name="abacus")

    monkeypatch.setattr(cli, "import_module", lacks)
    with pytest.raises(ModuleNotFoundError, match="abacus"):
        cli.main(["bench", "splat"])


def test_help_of_forecast_needs_no_torch() -> None:
    code = (
        "import sys\nfrom vestcl.cli import main as cli\n"
        "try:\n    cli.main(['forecast', '--help'])\nexcept SystemExit as end:\n"
        "    sys.exit(end.code or 'torch' in sys.modules or 'cv2' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_label_ids_are_those_of_the_readers() -> None:
    assert get_args(get_type_hints(cli.Forecast)["label_ids"]) == get_args(LabelKind)


def test_doctor_reports_what_works(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    info = opencl.select()
    sound = doctor.DeviceReport(info, tuple(doctor.DeviceCheck(name, True) for name in doctor.STEPS), ())
    ill = doctor.DeviceReport(info, (doctor.DeviceCheck("build", False, "no [ld]"),), ("build: no [ld]",))

    monkeypatch.setattr(doctor, "examine", lambda timeout: doctor.Report((sound,), info.index, ()))
    assert cli.main(["doctor"]) == 0
    assert "vestcl's device works" in capsys.readouterr().out

    monkeypatch.setattr(doctor, "examine", lambda timeout: doctor.Report((ill,), info.index, ("mend [it]",)))
    assert cli.main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "vestcl's device does not work" in out
    assert f"{info.index} build: no [ld]\nmend [it]\n" in out
