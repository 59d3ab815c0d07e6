"""`vestcl prepare` from its command line: inputs, shards, streets and errors."""

import dataclasses
import errno
import resource
from pathlib import Path

import numpy as np
import pytest
from data_files import write_text
from onnx_files import write_mix
from prepare_scenes import FRAMES, HEIGHT, SMALL, WIDTH, contents, counted, options, run, write_drive

from vestcl.cli import main as cli
from vestcl.cli import prepare as prepare_command
from vestcl.io.images import write_pixels
from vestcl.prepare.clip import frame_keys
from vestcl.prepare.files import frame_path
from vestcl.prepare.prepared import find_prepared


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_drive(tmp_path / "drive")


def test_estimators_are_distinguished_by_name_or_files(tmp_path: Path) -> None:
    weights = write_text(tmp_path / "network" / "weights", "12")
    networks: tuple[dict[str, str], ...] = ({}, {"depth_model": "a/b"}, {"mask_model": "a/b"}, {"depth_model": "a/c"})
    names = [prepare_command.estimators(options(**network)) for network in networks]
    names.append(prepare_command.estimators(options(depth_model=str(tmp_path / "network"))))
    weights.write_text("123")
    names.append(prepare_command.estimators(options(depth_model=str(tmp_path / "network"))))
    assert len(set(names)) == 6 and names[0] == ""


def test_onnx_files_are_distinguished_with_their_description(tmp_path: Path) -> None:
    file = write_mix(tmp_path / "network.onnx", [[1.0, 0.0, 0.0]])
    keys = [prepare_command.estimators(options(depth_model=str(file)))]
    for text in ('{"metres": 2}', '{"metres": 33}'):
        file.with_suffix(".json").write_text(text)
        keys.append(prepare_command.estimators(options(depth_model=str(file))))
    keys.append(prepare_command.estimators(options(mask_model=str(file))))
    write_mix(file, [[1.0, 0.0, 0.0]], (44, 66))
    keys.append(prepare_command.estimators(options(depth_model=str(file))))
    assert len(set(keys)) == 5


def test_shards_part_the_clips() -> None:
    def texts(*part: int) -> list[str]:
        return [task.text for task in prepare_command.plan(options("street:3-7", "street:9", out=Path("x")), *part)]

    assert texts() == [f"street:{seed}" for seed in (3, 4, 5, 6, 7, 9)]
    assert [texts(part, 3) for part in range(3)] == [
        ["street:3", "street:6"],
        ["street:4", "street:7"],
        ["street:5", "street:9"],
    ]
    assert texts(7, 8) == []


def test_the_shard_is_given_or_torchruns() -> None:
    torchrun = {"RANK": "2", "WORLD_SIZE": "4"}
    assert prepare_command.shard(None, {}) == (0, 1)
    assert prepare_command.shard(None, {"RANK": "2"}) == (0, 1)
    assert prepare_command.shard(None, torchrun) == (2, 4)
    assert prepare_command.shard("1/3", torchrun) == (1, 3)
    for wrong in ("3/3", "1", "-1/3", "a/b", "1/0", "1/3/5"):
        with pytest.raises(ValueError, match=f"`shard` must be I/N with 0 <= I < N, got {wrong}"):
            prepare_command.shard(wrong, {})
    with pytest.raises(ValueError, match="RANK/WORLD_SIZE must be I/N with 0 <= I < N, got 4/4"):
        prepare_command.shard(None, {"RANK": "4", "WORLD_SIZE": "4"})


def test_torchruns_ranks_share_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in range(2):
        monkeypatch.setenv("RANK", str(rank))
        assert run(options("street:5-6", out=tmp_path), capsys) == (FRAMES, 0)
        assert [clip.name for clip in find_prepared(tmp_path)] == ["street 5", "street 6"][: rank + 1]


def test_random_driving() -> None:
    default = prepare_command.open_input("street:5", options())
    drawn, again, other = (prepare_command.open_input(f"street:{i}", options(drive="random")) for i in (5, 5, 6))
    assert default.name == drawn.name == "street 5"
    assert default[0].timestamp == 0
    starts = [clip[0].timestamp for clip in (drawn, again, other)]
    assert starts[0] == starts[1] != starts[2] and all(0 < start < 60 for start in starts if start is not None)
    poses = [np.array([sample.world_from_cam for sample in clip], np.float64) for clip in (default, drawn, again)]
    speeds = [np.linalg.norm(pose[1, :3, 3] - pose[0, :3, 3]) for pose in poses]
    assert speeds[1] == speeds[2] != speeds[0]
    assert frame_keys(drawn) == frame_keys(again)
    assert not set(frame_keys(drawn)) & set(frame_keys(default))


def test_streets_without_their_depth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    true, stereo = (prepare_command.open_input("street:5", options(street_depth=kind)) for kind in ("true", "stereo"))
    assert all(sample.depth is not None for sample in true)
    for known, sample in zip(true, stereo, strict=True):
        assert sample.depth is None
        assert sample.right is not None and known.right is not None
        assert sample.right.image == known.right.image and sample.labels == known.labels
        assert sample.world_from_cam is not None and known.world_from_cam is not None
        assert np.array_equal(sample.world_from_cam, known.world_from_cam)
    assert not set(frame_keys(true)) & set(frame_keys(stereo))
    settings = options("street:5", out=tmp_path, frames=2)
    assert run(settings, capsys) == (2, 0)
    matched = dataclasses.replace(settings, street_depth="stereo")
    assert run(matched, capsys) == (2, 0)
    assert run(matched, capsys) == (0, 2)
    (clip,) = find_prepared(tmp_path)
    truth = true[1].read_depth()
    near = truth < 20
    ratio = clip.frame(1).layers.depth[near] / truth[near]
    assert 0.8 < np.median(ratio) < 1.2 and np.abs(ratio - 1).max() > 0.01  # measured, not copied


def test_errors(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def error(*arguments: str) -> str:
        assert cli.main(["prepare", *arguments]) == 2
        return " ".join(capsys.readouterr().err.split())

    out = ("--out", str(tmp_path / "cache"))
    file = write_text(tmp_path / "file", "")
    assert error("street:5") == "error: street:5: is not a folder to keep a cache in; `--out` must name one"
    assert error(str(tmp_path / "nowhere"), *out).endswith("nowhere: no such file or folder")
    assert "unrecognised dataset layout" in error(str(tmp_path), *out)
    assert error("street:7-5", *out).endswith("must have streets from a lower to a higher seed, got street:7-5")
    assert error("street:5", *out, "--rig", "grey").endswith("it does not take --rig")
    assert error("street:5", *out, "--mask-model", "x").endswith("it does not take --mask-model")
    assert error("street:5", *out, "--frames", "1") == "error: --frames must be 2 or more, got 1"
    assert error("street:5", *out, "--workers", "0") == "error: --workers must be 1 or more, got 0"
    assert error("street:5", *out, "--shard", "2/2").startswith("error: --shard must be I/N")
    assert error("street:5", "--out", str(file)) == f"error: --out must be a folder, got the file {file}"
    assert error(*out) == "error: INPUTS must be one or more clips, got none"
    assert "is where both street:5 and street:5 would go" in error("street:5", "street:5", *out)
    write_text(folder / ".vestcl", "")
    assert error(str(folder), *SMALL).endswith("can't be written (Not a directory); `--out` names another folder")
    assert not (tmp_path / "cache").exists()


def test_one_clips_failure_stops_no_other(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    last_image = max((folder / "image").iterdir())
    last_image.write_bytes(last_image.read_bytes()[:500])
    lonely = tmp_path / "lonely"
    write_pixels(lonely / "image" / "0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_text(lonely / "camera.json", (folder / "camera.json").read_text())
    plain = options(str(lonely), str(folder), "street:5", out=tmp_path / "cache")
    with pytest.raises(ValueError, match=r"lonely: must have 2 frames or more, got 1.*\n.*is not an image"):
        prepare_command.run(plain)
    assert counted(capsys.readouterr().out.rpartition("stage")[2]) == (FRAMES, 0)
    assert [clip.name for clip in find_prepared(tmp_path / "cache")] == ["street 5"]


def test_a_full_disk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Files may not grow beyond 1 kB, which an error of the same kind tells."""
    settings, limits = options("street:5", out=tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    folder = tmp_path / f"street_5-{HEIGHT}x{WIDTH}"
    run(settings, capsys)
    whole = contents(tmp_path)
    frame_path(folder, 2).unlink()
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, limits[1]))
    try:
        with pytest.raises(OSError, match=r"can't be written: .* what is prepared so far stays, .*000002") as caught:
            prepare_command.run(settings)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.errno == errno.EFBIG
    assert sorted(path.name for path in folder.glob("*.safetensors")) == [f"{i:06}.safetensors" for i in (0, 1, 3)]
    assert not (folder / "clip.json").exists()
    assert run(settings, capsys) == (1, FRAMES - 1)
    assert contents(tmp_path) == whole
