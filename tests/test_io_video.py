"""vestcl.io.video."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from data_files import picture, real, write_text
from PIL import Image

from vestcl import io
from vestcl.io import video


def frames(count: int, height: int = 32, width: int = 48) -> list[np.ndarray]:
    """Flat pictures, each of a colour that is told from its neighbours' after lossy coding."""
    return [np.full((height, width, 3), (40 + 8 * i, 200 - 6 * i, 90), np.uint8) for i in range(count)]


def index_of(frame: np.ndarray) -> int:
    return round((float(frame[..., 0].mean()) - 40) / 8)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    io.write_mp4(tmp_path / "new" / "a.mp4", frames(25), fps=12.5)
    return tmp_path / "new" / "a.mp4"


def test_mp4_there_and_back(clip: Path) -> None:
    opened = io.Video(clip)
    assert (len(opened), opened.height, opened.width, opened.fps) == (25, 32, 48, 12.5)
    for written, read in zip(frames(25), opened, strict=True):
        assert read.dtype == np.uint8 and np.abs(read.astype(int) - written).max() < 8
    assert list(clip.parent.iterdir()) == [clip]


def test_any_order(clip: Path) -> None:
    opened = io.Video(clip)
    for index in (24, 0, 23, 7, 8, 6, 24, 1, -1, -25):
        assert index_of(opened[index]) == index % 25
    for index in (25, -26):
        with pytest.raises(IndexError):
            opened[index]


def test_a_sliding_window_decodes_once(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, restarts = io.Video(clip), []
    restart = io.Video._restart
    monkeypatch.setattr(io.Video, "_restart", lambda self: (restarts.append(1), restart(self)))
    for start in range(25 - 9):
        assert [index_of(opened[i]) for i in range(start, start + 9)] == list(range(start, start + 9))
    assert not restarts and len(opened._kept) <= video.KEPT


def test_frames_are_the_callers_own(clip: Path) -> None:
    opened = io.Video(clip)
    opened[0][:] = 0
    assert index_of(opened[0]) == 0


def test_pickle(clip: Path) -> None:
    opened = io.Video(clip)
    opened[5]
    copy = pickle.loads(pickle.dumps(opened))
    assert index_of(copy[3]) == 3 and len(copy) == 25


def test_odd_sizes_are_padded(tmp_path: Path) -> None:
    io.write_mp4(tmp_path / "a.mp4", frames(3, 31, 47), 10)
    assert io.Video(tmp_path / "a.mp4")[2].shape == (32, 48, 3)


def test_a_header_without_a_count(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video.cv2, "CAP_PROP_FRAME_COUNT", -1)  # an unknown property is 0
    opened = io.Video(clip)
    assert len(opened) == 25 and index_of(opened[0]) == 0


def test_a_header_that_promises_too_much(clip: Path) -> None:
    opened = io.Video(clip)
    opened.frames = 30
    with pytest.raises(ValueError, match=r"a\.mp4: ends after 25 frames; its header tells of 30"):
        opened[29]


def test_refuses_to_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"no\.mp4: no such file"):
        io.Video(tmp_path / "no.mp4")
    with pytest.raises(ValueError, match=r"text\.mp4: OpenCV can't open it"):
        io.Video(write_text(tmp_path / "text.mp4", "hello"))
    capfd.readouterr()  # ffmpeg grumbles


def test_refuses_to_write(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for write, name in ((io.write_mp4, "a.mp4"), (io.write_gif, "a.gif")):
        with pytest.raises(ValueError, match="at least one frame"):
            write(tmp_path / name, [], 10)
        with pytest.raises(ValueError, match="`fps` must be positive, got 0"):
            write(tmp_path / name, frames(1), 0)
        with pytest.raises(ValueError, match=r"`frames` must be \[H, W, 3\] uint8, got float64"):
            write(tmp_path / name, [np.zeros((4, 4, 3))], 10)
        with pytest.raises(ValueError, match=r"`frames` must all be \[32, 48, 3\] uint8, got uint8 \[8, 8, 3\]"):
            write(tmp_path / name, [*frames(2), picture(8, 8)], 10)
        with pytest.raises(ValueError, match="must end in"):
            write(tmp_path / "a.mkv", frames(1), 10)
    with pytest.raises(ValueError, match="this OpenCV can't write codec 'XXXX' to MP4; try 'mp4v'"):
        io.write_mp4(tmp_path / "a.mp4", frames(1), 10, codec="XXXX")
    with pytest.raises(ValueError, match="`codec` must be four letters"):
        io.write_mp4(tmp_path / "a.mp4", frames(1), 10, codec="h265x")
    assert not list(tmp_path.iterdir())
    capfd.readouterr()  # ffmpeg grumbles


def test_gif(tmp_path: Path) -> None:
    io.write_gif(tmp_path / "a.gif", iter(frames(5)), 12.5)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["loop"], image.info["duration"]) == (5, (48, 32), 0, 80)
        image.seek(4)
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - frames(5)[4]).max() <= 2
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_real_motorway() -> None:
    opened = io.Video(real("highway.mp4"))
    assert (len(opened), opened.height, opened.width, opened.fps) == (221, 540, 960, 25)
    assert opened[30].std() > 20
