"""vestcl.io.exr."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from data_files import write_text

from vestcl import io
from vestcl.io.exr import linear_from_srgb, srgb_from_linear


def frame(height: int = 5, width: int = 7) -> io.ExrFrame:
    rng = np.random.default_rng(0)
    return io.ExrFrame(
        image=rng.random((3, height, width)).astype(np.float32),
        depth=rng.uniform(1, 1000, (1, height, width)).astype(np.float32),
        coverage=rng.random((1, height, width)).astype(np.float32),
        motion=rng.normal(size=(3, height, width)).astype(np.float32),
    )


def test_frame_there_and_back(tmp_path: Path) -> None:
    written = frame()
    io.write_exr_frame(tmp_path / "new" / "a.exr", written)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.exr"]
    read = io.read_exr_frame(tmp_path / "new" / "a.exr")
    for name in ("depth", "coverage", "motion"):
        assert getattr(read, name).dtype == np.float32
        assert np.array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_allclose(read.image, written.image, atol=2e-7)
    assert np.array_equal(io.to_pixels(read.image, 16), io.to_pixels(written.image, 16))


def test_channel_names_as_other_programs_see_them(tmp_path: Path) -> None:
    written = frame()
    io.write_exr_frame(tmp_path / "a.exr", written)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        assert "linear light" in file.header()["comments"]
    assert set(channels) == {"R", "G", "B", "A", "Z", "motion.X", "motion.Y", "motion.Z"}
    assert all(channel.dtype == np.float32 for channel in channels.values())
    assert np.array_equal(channels["motion.Y"], written.motion[1])
    np.testing.assert_allclose(channels["G"], linear_from_srgb(written.image[1]), rtol=1e-6)


def test_parts_of_a_frame(tmp_path: Path) -> None:
    io.write_exr_frame(tmp_path / "a.exr", io.ExrFrame(depth=frame().depth))
    read = io.read_exr_frame(tmp_path / "a.exr")
    assert read.image is None and read.motion is None and read.coverage is None
    assert np.array_equal(read.depth, frame().depth)


def test_transfer_function_by_hand() -> None:
    assert linear_from_srgb([0, 1]).tolist() == [0, 1]
    assert linear_from_srgb(0.5) == pytest.approx(0.21404114)
    assert linear_from_srgb(0.04) == pytest.approx(0.04 / 12.92)
    values = np.linspace(-0.5, 2, 1001)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-12)


@pytest.mark.parametrize(("given", "stored"), [("f4", "f4"), ("f8", "f4"), ("f2", "f2"), ("u4", "u4"), ("u1", "f4")])
def test_types(tmp_path: Path, given: str, stored: str) -> None:
    channel = np.arange(12).reshape(3, 4).astype(given)[:, ::-1]
    channels = {"Z": channel}
    io.write_exr(tmp_path / "a.exr", channels, "a comment")
    assert channels["Z"] is channel
    read = io.read_exr(tmp_path / "a.exr")["Z"]
    assert read.dtype == stored and np.array_equal(read, channel)


def test_what_is_not_finite_stays(tmp_path: Path) -> None:
    io.write_exr(tmp_path / "a.exr", {"Z": np.array([[np.inf, np.nan, -np.inf]])})
    np.testing.assert_array_equal(io.read_exr(tmp_path / "a.exr")["Z"], [[np.inf, np.nan, -np.inf]])


def test_refuses_to_write(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must have at least one channel"):
        io.write_exr(tmp_path / "a.exr", {})
    with pytest.raises(ValueError, match=r"channel `B` must be \[H, W\] as the first one, \[2, 3\], got \[2, 4\]"):
        io.write_exr(tmp_path / "a.exr", {"A": np.zeros((2, 3)), "B": np.zeros((2, 4))})
    with pytest.raises(ValueError, match=r"must end in \.exr"):
        io.write_exr(tmp_path / "a.png", {"A": np.zeros((2, 3))})
    with pytest.raises(ValueError, match=r"`depth` must be \[1, H, W\], got \[2, 3\]"):
        io.write_exr_frame(tmp_path / "a.exr", io.ExrFrame(depth=np.zeros((2, 3))))
    with pytest.raises(ValueError, match="at least one channel"):
        io.write_exr_frame(tmp_path / "a.exr", io.ExrFrame())
    assert not list(tmp_path.iterdir())


def test_damage_is_found_wherever_it_is_and_prints_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.exr"
    depth = np.add.outer(np.arange(40.0), np.arange(50.0))
    io.write_exr(path, {"Z": depth})
    content = path.read_bytes()
    for end in range(0, len(content), 31):
        path.write_bytes(content[:end])
        with pytest.raises(ValueError, match=r"a\.exr: is not an OpenEXR image, or a damaged one"):
            io.read_exr(path)
    for position in range(len(content) // 2, len(content), 31):  # in the compressed numbers
        path.write_bytes(content[:position] + bytes([content[position] ^ 255]) + content[position + 1 :])
        with pytest.raises(ValueError, match=r"a\.exr: is not an OpenEXR image, or a damaged one"):
            io.read_exr(path)
    assert capsys.readouterr().out == ""


def test_refuses_to_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"no\.exr: no such file"):
        io.read_exr(tmp_path / "no.exr")
    with pytest.raises(ValueError, match=r"text\.exr: is not an OpenEXR image"):
        io.read_exr(write_text(tmp_path / "text.exr", "hello"))
    io.write_exr_frame(tmp_path / "half.exr", frame(64, 64))
    content = (tmp_path / "half.exr").read_bytes()
    (tmp_path / "half.exr").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"half\.exr: is not an OpenEXR image, or a damaged one"):
        io.read_exr(tmp_path / "half.exr")
    io.write_exr(tmp_path / "a.exr", {"Q": np.zeros((2, 3))})
    with pytest.raises(ValueError, match=r"a\.exr: has none of a frame's channels; it has Q"):
        io.read_exr_frame(tmp_path / "a.exr")
    window = {"dataWindow": ((2, 1), (5, 3)), "displayWindow": ((0, 0), (9, 9))}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | {
        name: tuple(np.array(corner, np.int32) for corner in corners) for name, corners in window.items()
    }
    with OpenEXR.File(header, {"Z": np.zeros((3, 4), np.float32)}) as file:
        file.write(str(tmp_path / "crop.exr"))
    with pytest.raises(ValueError, match=r"crop\.exr: its data window must be its display window"):
        io.read_exr(tmp_path / "crop.exr")
    parts = [OpenEXR.Part({"name": name}, {"Z": np.zeros((3, 4), np.float32)}) for name in ("a", "b")]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "parts.exr"))
    with pytest.raises(ValueError, match=r"parts\.exr: must have one part, got 2"):
        io.read_exr(tmp_path / "parts.exr")
    capfd.readouterr()  # OpenEXR grumbles
