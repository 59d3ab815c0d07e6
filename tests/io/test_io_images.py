"""vestcl.io.images and vestcl.io.atomic."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from data_files import noise_image, write_text
from PIL import Image

from vestcl import io
from vestcl.io.atomic import replacing, write_bytes


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(5, 7, 3), (5, 7), (1, 1, 3)])
def test_png_round_trip(tmp_path: Path, shape: tuple[int, ...], dtype: type) -> None:
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    io.write_pixels(tmp_path / "new" / "a.png", pixels)
    read = io.read_pixels(tmp_path / "new" / "a.png")
    assert read.dtype == dtype and np.array_equal(read, pixels)
    assert io.image_size(tmp_path / "new" / "a.png") == shape[:2]


def test_colours_are_rgb(tmp_path: Path) -> None:
    Image.new("RGB", (2, 1), (255, 128, 0)).save(tmp_path / "a.png")
    assert io.read_pixels(tmp_path / "a.png")[0, 0].tolist() == [255, 128, 0]
    io.write_pixels(tmp_path / "b.png", np.array([[[255, 128, 0]]], np.uint8))
    with Image.open(tmp_path / "b.png") as image:
        assert image.getpixel((0, 0)) == (255, 128, 0)


def test_alpha_is_dropped(tmp_path: Path) -> None:
    Image.new("RGBA", (2, 1), (255, 128, 0, 7)).save(tmp_path / "a.png")
    assert io.read_pixels(tmp_path / "a.png").tolist() == [[[255, 128, 0]] * 2]


@pytest.mark.parametrize("name", ["a.jpg", "a.JPEG"])
def test_jpeg_is_close(tmp_path: Path, name: str) -> None:
    smooth = np.stack([np.add.outer(np.arange(32), np.arange(48))] * 3, axis=2).astype(np.uint8) * 3
    io.write_pixels(tmp_path / name, smooth)
    assert np.abs(io.read_pixels(tmp_path / name).astype(int) - smooth).max() <= 4


@pytest.mark.parametrize("bits", [8, 16])
def test_floats_by_hand_and_back(tmp_path: Path, bits: int) -> None:
    pixels = io.to_pixels(np.array([[[0.0, 1.0, 0.5, -3.0, 9.0]]]), bits)
    assert pixels.tolist() == [[0, 2**bits - 1, 2 ** (bits - 1), 0, 2**bits - 1]]
    exact = np.arange(2**bits, dtype=np.uint8 if bits == 8 else np.uint16)[None]
    image = io.to_float(exact)
    assert image.dtype == np.float32 and image.shape == (3, 1, 2**bits) and image.flags.c_contiguous
    assert image.min() == 0 and image.max() == 1
    assert np.array_equal(io.to_pixels(image, bits)[:, :, 1], exact)
    io.write_image(tmp_path / "a.png", torch.from_numpy(image), bits)
    assert np.array_equal(io.read_image(tmp_path / "a.png"), image)


def test_planes_are_red_green_blue() -> None:
    assert io.to_float(np.array([[[255, 51, 0]]], np.uint8)).reshape(-1).tolist() == [1, np.float32(0.2), 0]


def test_damaged_files_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    io.write_pixels(tmp_path / "a.png", noise_image(64, 64))
    io.write_pixels(tmp_path / "a.jpg", noise_image(64, 64))
    for name in ("a.png", "a.jpg"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(ValueError, match=f"{name}: is not an image, or a damaged one"):
            io.read_pixels(path)
    for read in (io.read_pixels, io.read_image, io.image_size):
        with pytest.raises(ValueError, match=r"text.png: is not an image"):
            read(write_text(tmp_path / "text.png", "hello"))
        with pytest.raises(ValueError, match=r"nothing.png: No such file"):
            read(tmp_path / "nothing.png")
    with pytest.raises(ValueError, match=r"empty.png: is not an image"):
        io.read_pixels(write_text(tmp_path / "empty.png"))
    with pytest.raises(ValueError, match="Is a directory"):
        io.read_pixels(tmp_path)
    capfd.readouterr()  # libpng grumbles


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("kind", "options"),
    [("PNG", {}), ("JPEG", {}), ("JPEG", {"progressive": True}), ("JPEG", {"exif": b"Exif\0\0\xff\xd9"})],
)
def test_a_file_that_ends_too_early_is_found_wherever_it_ends(
    tmp_path: Path, kind: str, options: dict[str, object], capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a"
    content = encoded(Image.fromarray(noise_image(40, 50)), kind, **options)
    for end in range(0, len(content), 29):
        path.write_bytes(content[:end])
        with pytest.raises(ValueError, match=r"a: is not an image, or a damaged one$"):
            io.read_pixels(path)
    path.write_bytes(content + b"what a telephone appends")
    assert io.read_pixels(path).shape == (40, 50, 3)
    assert capfd.readouterr().out == ""


def test_a_byte_that_changed_in_a_png_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    content = bytearray(encoded(Image.fromarray(noise_image(40, 50)[:, :, 0]), "PNG"))
    for position in range(0, len(content), 29):
        content[position] ^= 4
        path.write_bytes(content)
        for read in (io.read_pixels, lambda name: io.read_train_ids(name, "labelIds")):
            with pytest.raises(ValueError, match=r"a\.png: is not an image, or a damaged one$"):
                read(path)
        content[position] ^= 4


def test_refuses(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in \.png, \.jpg or \.jpeg"):
        io.write_pixels(tmp_path / "a.bmp", noise_image())
    with pytest.raises(ValueError, match=r"`pixels` must be uint8 for \.jpg, got uint16"):
        io.write_pixels(tmp_path / "a.jpg", noise_image().astype(np.uint16))
    with pytest.raises(ValueError, match=r"`pixels` must be \[H, W, 3\] or \[H, W\] and not empty, got \[6, 8, 2\]"):
        io.write_pixels(tmp_path / "a.png", noise_image()[:, :, :2])
    with pytest.raises(ValueError, match="not empty"):
        io.write_pixels(tmp_path / "a.png", noise_image()[:0])
    with pytest.raises(ValueError, match="`quality`"):
        io.write_pixels(tmp_path / "a.jpg", noise_image(), quality=0)
    with pytest.raises(ValueError, match=r"`image` must be floating, \[3, H, W\] or \[1, H, W\], got float64 \[2, 4\]"):
        io.to_pixels(np.zeros((2, 4)))
    with pytest.raises(ValueError, match="must not have NaN"):
        io.write_image(tmp_path / "a.png", np.full((3, 2, 2), np.nan))
    with pytest.raises(ValueError, match="`bits`"):
        io.to_pixels(np.zeros((3, 2, 2)), 10)
    with pytest.raises(ValueError, match="`pixels` must be uint8 or uint16"):
        io.to_float(np.zeros((2, 2)))
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_bytes(b"ne")
            assert temporary.suffix == ".bin" and path.read_bytes() == b"old"
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


def test_a_folder_that_can_not_be_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="its folder can't be made"):
        io.write_pixels(write_text(tmp_path / "file") / "a.png", noise_image())
