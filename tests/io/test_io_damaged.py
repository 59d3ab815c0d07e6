"""Readers of vestcl.io on files that are cut, damaged, giant by their header, or no files at all: one line each."""

import os
import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from data_files import noise_image
from PIL import Image

from vestcl import io
from vestcl.io.atomic import read_bytes

Read = Callable[[Path], object]

READERS: dict[str, list[Read]] = {
    "rgb.png": [io.read_pixels, io.read_image, io.image_size],
    "depth.png": [lambda path: io.read_depth(path, 256), lambda path: io.read_cityscapes_disparity(path, 0.2, 2000)],
    "labels.png": [lambda path: io.read_train_ids(path, "trainIds"), io.read_ego_vehicle],
    "rgb.jpg": [io.read_pixels, io.image_size],
    "progressive.jpg": [io.read_pixels, io.image_size],
    "depth.exr": [io.read_exr, io.read_depth],
    "depth.npy": [io.read_depth],
}


def contents(tmp_path: Path) -> dict[str, bytes]:
    """A small file of each kind."""
    rng = np.random.default_rng(0)
    io.write_pixels(tmp_path / "rgb.png", noise_image(20, 30))
    io.write_pixels(tmp_path / "depth.png", rng.integers(0, 65536, (20, 30)).astype(np.uint16))
    io.write_pixels(tmp_path / "labels.png", rng.integers(0, 19, (20, 30)).astype(np.uint8))
    io.write_pixels(tmp_path / "rgb.jpg", noise_image(20, 30))
    Image.fromarray(noise_image(20, 30)).save(tmp_path / "progressive.jpg", progressive=True)
    io.write_exr(tmp_path / "depth.exr", {"Z": rng.random((20, 30)).astype(np.float32)})
    np.save(tmp_path / "depth.npy", rng.random((20, 30)).astype(np.float32))
    return {name: (tmp_path / name).read_bytes() for name in READERS}


def refusals(path: Path, reads: list[Read]) -> list[str]:
    """The messages of those that refuse; each has to name the file in one printable line."""
    messages = [message for read in reads if (message := refusal(path, read))]
    assert all(message.startswith(f"{path}: ") and message.isprintable() for message in messages)
    return messages


def refusal(path: Path, read: Read) -> str:
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return ""


def png(height: int, width: int, data: bytes = b"", kind: int = 2) -> bytes:
    """A PNG whose header claims what it likes, with true checksums."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)), (b"IDAT", data), (b"IEND", b"")]
    packed = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def npy(header: str, data: bytes = b"") -> bytes:
    padded = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + data


def test_all_are_read_when_whole(tmp_path: Path) -> None:
    contents(tmp_path)
    for name, reads in READERS.items():
        assert refusals(tmp_path / name, reads) == []


@pytest.mark.parametrize("name", READERS)
def test_truncated(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Cut anywhere, every one is refused, and no library writes to the terminal; a size may be read from the start."""
    whole = contents(tmp_path)[name]
    path, reads = tmp_path / name, [read for read in READERS[name] if read is not io.image_size]
    for length in [*range(0, len(whole), max(len(whole) // 60, 1)), len(whole) - 1]:
        path.write_bytes(whole[:length])
        assert len(refusals(path, reads)) == len(reads), length
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["rgb.png", "depth.png", "labels.png"])
def test_a_flipped_bit_of_a_png(tmp_path: Path, name: str) -> None:
    whole = contents(tmp_path)[name]
    path, reads = tmp_path / name, [read for read in READERS[name] if read is not io.image_size]
    for bit in np.random.default_rng(1).integers(0, 8 * len(whole), 60):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(damaged)
        assert len(refusals(path, reads)) == len(reads), bit


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file(tmp_path: Path, name: str) -> None:
    path, reads = tmp_path / name, READERS[name]
    os.mkfifo(path)
    assert set(refusals(path, reads)) == {f"{path}: must be a regular file, got a FIFO"}
    path.unlink()
    path.mkdir()
    assert set(refusals(path, reads)) == {f"{path}: Is a directory"}
    path.rmdir()
    path.symlink_to("/dev/zero")
    assert set(refusals(path, reads)) == {f"{path}: must be a regular file, got a character device"}
    path.unlink()
    path.touch()
    assert len(refusals(path, reads)) == len(reads)
    path.unlink()
    assert all("o such file" in message for message in refusals(path, reads))


def test_files_that_are_too_long(tmp_path: Path) -> None:
    """A sparse file of a terabyte takes no memory and is not read."""
    for name in READERS:
        with (tmp_path / name).open("wb") as file:
            file.truncate(1 << 40)
        messages = refusals(tmp_path / name, READERS[name])
        assert set(messages) == {f"{tmp_path / name}: must have at most 1073741824 bytes, got 1099511627776"}
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(ValueError, match="a: must have at most 4 bytes, got 5"):
        read_bytes(tmp_path / "a", 4)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "rgb.png",
            png(1_000_000, 1_000_000),
            "must have 1 to 65536 pixels per side and at most 67108864 in all, got 1000",
        ),
        ("rgb.png", png(1 << 31, 1), "must have 1 to 65536 pixels per side"),
        ("rgb.png", png(60_000, 60_000, zlib.compress(bytes(1000))), "at most 67108864 in all, got 60000 x 60000"),
        ("rgb.png", png(0, 30), "must have 1 to 65536 pixels per side"),
        ("rgb.png", png(8000, 8000, zlib.compress(bytes(1000))), "is not an image, or a damaged one"),
        ("depth.png", png(60_000, 60_000, kind=0), "at most 67108864 in all"),
        ("labels.png", png(60_000, 60_000, kind=0), "at most 67108864 in all"),
        ("depth.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000)}"), "at most 67108864"),
        (
            "depth.npy",
            npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, 9, 99999999999999999999)}"),
            "per side",
        ),
        ("depth.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-3, -4)}", bytes(48)), "per side"),
        ("depth.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (8000, 8000)}", bytes(64)), "damaged"),
        ("depth.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2)}", bytes(17)), "damaged"),
        ("depth.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (0, 2)}"), "1 to 65536 pixels per side"),
        ("depth.npy", npy("{'descr': '|V99999999', 'fortran_order': False, 'shape': (2, 2)}"), "array of numbers"),
        ("depth.npy", npy("(" * 90), "is not an NPY array"),
        ("depth.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 31), "is not an NPY array"),
        ("depth.npy", b"\x93NUMPY\x07\x00" + bytes(100), "is not an NPY array"),
    ],
)
def test_headers_that_claim_too_much(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for said in refusals(tmp_path / name, [read for read in READERS[name] if read is not io.image_size]):
        assert message in said
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10  # KiB


def test_jpeg_headers(tmp_path: Path) -> None:
    whole = contents(tmp_path)["rgb.jpg"]
    at = whole.index(b"\xff\xc0") + 5
    path = tmp_path / "rgb.jpg"
    for height, width, message in [(65535, 65535, "at most 67108864 in all"), (0, 30, "per side"), (20, 0, "per side")]:
        path.write_bytes(whole[:at] + struct.pack(">HH", height, width) + whole[at + 4 :])
        said = refusals(path, READERS["rgb.jpg"])
        assert len(said) == 2 and all(message in text for text in said)
    scan = whole.index(b"\xff\xda")
    path.write_bytes(whole[:scan] + 101 * whole[scan:-2] + whole[-2:])
    (said,) = refusals(path, [io.read_pixels])
    assert said.endswith("is not an image, or a damaged one")


def test_exr_headers(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = contents(tmp_path)["depth.exr"]
    path = tmp_path / "depth.exr"
    at = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for window, message in [
        ((0, 0, 999_999, 999_999), "at most 67108864 in all"),
        ((0, 0, 2**31 - 1, 2**31 - 1), "per side"),
        ((-(2**31), 0, 2**31 - 1, 0), "per side"),
        ((9, 9, 0, 0), "per side"),
        ((0, 0, 8000, 8000), "is not an OpenEXR image, or a damaged one"),
    ]:
        path.write_bytes(whole[:at] + struct.pack("<4i", *window) + whole[at + 16 :])
        assert all(message in text for text in refusals(path, READERS["depth.exr"]))
    path.write_bytes(whole[:4] + struct.pack("<I", 2 | 0x800) + whole[8:])
    assert all("with deep data" in text for text in refusals(path, READERS["depth.exr"]))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"])
@pytest.mark.parametrize("height", [1, 16, 33, 257])
def test_exr_of_every_compression_is_read(tmp_path: Path, name: str, height: int) -> None:
    values = np.random.default_rng(0).random((height, 20)).astype(np.float32)
    header = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": values}) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_allclose(io.read_exr(tmp_path / "a.exr")["Z"], values, atol=0.02)


def test_bytes_after_the_end_are_allowed(tmp_path: Path) -> None:
    """Telephones append to JPEGs; a thumbnail in EXIF data has its own end."""
    whole = contents(tmp_path)
    for name in ("rgb.png", "rgb.jpg", "progressive.jpg"):
        (tmp_path / name).write_bytes(whole[name] + b"appended")
        assert io.read_pixels(tmp_path / name).shape == (20, 30, 3)
    with_thumbnail = whole["rgb.jpg"][:2] + b"\xff\xe1\x00\x06\xff\xd8\xff\xd9" + whole["rgb.jpg"][2:]
    (tmp_path / "rgb.jpg").write_bytes(with_thumbnail)
    assert io.read_pixels(tmp_path / "rgb.jpg").shape == (20, 30, 3)
    (tmp_path / "rgb.jpg").write_bytes(with_thumbnail[:-9])
    with pytest.raises(ValueError, match="is not an image, or a damaged one"):
        io.read_pixels(tmp_path / "rgb.jpg")


def test_a_signalling_nan_is_unknown(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[0x7FA00000, 0x3F800000]], np.uint32).view(np.float32))
    assert io.read_depth(tmp_path / "a.npy").tolist() == [[0, 1]]


@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_in_either_order(tmp_path: Path, order: str) -> None:
    depth = np.arange(1, 13, dtype=np.float64).reshape(3, 4)
    np.save(tmp_path / "a.npy", np.asarray(depth, order=order))
    assert np.array_equal(io.read_depth(tmp_path / "a.npy"), depth)


def test_fuzz(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Bytes changed, put in or cut, mostly in headers: read, or refused in one line; seeds 0 to 1,399."""
    whole, path, names = contents(tmp_path), tmp_path / "x", list(READERS)
    extremes = [b"\xff\xff\xff\x7f", b"\x7f\xff\xff\xff", bytes(4), b"\xff\xff\xff\xff", b"\x00\x10\x00\x00"]
    before, refused = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0
    for seed in range(1400):
        rng, name = np.random.default_rng(seed), names[seed % len(names)]
        content = bytearray(whole[name])
        head = min(len(content), int(rng.choice([40, 200, 400, len(content)])))
        at = int(rng.integers(head - 4))
        match int(rng.integers(4)):
            case 0:
                del content[int(rng.integers(len(content))) :]
            case 1:
                content[at] = rng.integers(256)
            case 2:
                content[at : at + 4] = extremes[rng.integers(len(extremes))]
            case _:
                content[at:at] = rng.bytes(int(rng.integers(1, 20)))
        path = tmp_path / f"x{Path(name).suffix}"
        path.write_bytes(content)
        refused += bool(refusals(path, READERS[name]))
    assert 700 < refused < 1400
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 << 10  # KiB
    capfd.readouterr()  # libjpeg and OpenEXR write about damage inside of data
