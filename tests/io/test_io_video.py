"""vestcl.io.video.reading and vestcl.io.video.writing."""

import os
import pickle
import random
import resource
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from data_files import noise_image, real, write_text
from PIL import Image
from video_files import REORDERED, cut, flat, index_of, write_video

from vestcl import io
from vestcl.io.video import decoder as _video_decoder
from vestcl.io.video import packets as _video_packets
from vestcl.io.video import writing as video_writing


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    io.write_mp4(tmp_path / "new" / "a.mp4", flat(25), fps=12.5)
    return tmp_path / "new" / "a.mp4"


def indices(video: io.Video) -> list[int]:
    return [index_of(frame) for frame in video]


def test_mp4_there_and_back(clip: Path) -> None:
    opened = io.Video(clip)
    assert (len(opened), opened.height, opened.width, opened.fps, opened.pixel_aspect) == (25, 32, 48, 12.5, 1)
    assert opened.seconds == pytest.approx(np.arange(25) / 12.5)
    for written, read in zip(flat(25), opened, strict=True):
        assert read.dtype == np.uint8 and np.abs(read.astype(int) - written).max() < 8
    assert list(clip.parent.iterdir()) == [clip]


def test_any_order(clip: Path) -> None:
    opened = io.Video(clip)
    for index in (24, 0, 23, 7, 8, 6, 24, 1, -1, -25):
        assert index_of(opened[index]) == index % 25
    for index in (25, -26):
        with pytest.raises(IndexError):
            opened[index]


@pytest.mark.parametrize(("suffix", "codec"), [("mp4", "libx264"), ("mkv", "libx264"), ("avi", "mpeg4")])
def test_frames_that_are_reordered_are_the_same_in_any_order(tmp_path: Path, suffix: str, codec: str) -> None:
    """Open groups of images: those before a key frame in time refer to the group before. AVI has no such times."""
    noise = [noise_image(32, 48, i // 3) // 2 + frame // 2 for i, frame in enumerate(flat(40))]
    options = REORDERED if codec == "libx264" else {"bf": "2"}
    opened = io.Video(write_video(tmp_path / f"a.{suffix}", noise, codec=codec, gop=7, options=options))
    expected = list(opened)
    assert len(expected) == 40 and opened.seconds == pytest.approx(np.arange(40) / 10)
    order = list(range(40)) * 2
    random.Random(0).shuffle(order)
    for index in order:
        assert np.array_equal(opened[index], expected[index]), index


def test_a_sliding_window_decodes_once(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, restarts = io.Video(clip), []
    restart = _video_decoder.Decoder._restart
    monkeypatch.setattr(
        _video_decoder.Decoder, "_restart", lambda self, key: (restarts.append(key), restart(self, key))
    )
    for start in range(25 - 9):
        assert [index_of(opened[i]) for i in range(start, start + 9)] == list(range(start, start + 9))
    assert not restarts and len(opened._decoder._kept) <= _video_decoder.KEPT


def test_frames_are_the_callers_own(clip: Path) -> None:
    opened = io.Video(clip)
    opened[0][:] = 0
    assert index_of(opened[0]) == 0


def test_pickle(clip: Path) -> None:
    opened = io.Video(clip)
    opened[5]
    copy = pickle.loads(pickle.dumps(opened))
    assert index_of(copy[3]) == 3 and len(copy) == 25


def test_a_forked_child_opens_the_file_for_itself(clip: Path) -> None:
    opened = io.Video(clip)
    opened[5]
    child = os.fork()
    if not child:
        signal.alarm(20)
        os._exit(0 if [index_of(opened[i]) for i in (0, 24, 3)] == [0, 24, 3] else 1)
    assert [index_of(opened[i]) for i in (6, 20, 2)] == [6, 20, 2]
    assert os.waitpid(child, 0)[1] == 0


def test_threads_share_a_video(clip: Path) -> None:
    opened, wrong = io.Video(clip), []

    def look(seed: int) -> None:
        order = random.Random(seed).choices(range(25), k=60)
        wrong.extend(index for index in order if index_of(opened[index]) != index)

    threads = [threading.Thread(target=look, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_times_are_the_containers(tmp_path: Path) -> None:
    """Six frames are missing; the rate is that of the others."""
    seconds = [(i if i < 8 else i + 6) / 10 for i in range(20)]
    for name in ("a.mkv", "a.mp4"):
        opened = io.Video(write_video(tmp_path / name, flat(20), seconds, options=REORDERED))
        assert opened.seconds == pytest.approx(np.array(seconds)) and opened.fps == 10
        assert indices(opened) == list(range(20))


def test_what_an_edit_list_cuts_away_is_not_counted(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "a.mp4", flat(20), options=REORDERED, gop=5)
    part = io.Video(cut(whole, tmp_path / "b.mp4", 0.7))
    assert part._decoder.stream.frames > len(part) == 13
    assert indices(part) == list(range(7, 20)) and index_of(part[0]) == 7 and part.seconds[1] == pytest.approx(0.1)


@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
def test_what_comes_before_the_first_key_frame_is_not_counted(tmp_path: Path, suffix: str) -> None:
    whole = write_video(tmp_path / "a.mp4", flat(20), options=REORDERED, gop=5)
    assert indices(io.Video(cut(whole, tmp_path / f"b.{suffix}", 0.7, from_key=False))) == list(range(10, 20))


@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
def test_a_file_that_ends_early(tmp_path: Path, suffix: str) -> None:
    noise = [noise_image(64, 96, i) for i in range(30)]
    whole = write_video(tmp_path / f"a.{suffix}", noise, options=REORDERED, gop=6)
    if suffix == "mp4":
        io.write_mp4(whole, noise, 10)  # its index comes first
    expected = list(io.Video(whole))
    content = whole.read_bytes()
    for share in (0.5, 0.72, 0.97):
        (tmp_path / f"b.{suffix}").write_bytes(content[: int(share * len(content))])
        part = io.Video(tmp_path / f"b.{suffix}")
        assert 10 < len(part) < 30
        for second, frame in zip(part.seconds, part, strict=True):
            assert np.array_equal(frame, expected[round(10 * second)])


def test_counting_does_not_decode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An hour opens in a second; of these minutes the last frame is a group of images away."""
    path = tmp_path / "long.mp4"
    frames = (np.full((16, 16, 3), i % 250, np.uint8) for i in range(3600))
    monkeypatch.setitem(video_writing.ENCODERS, "libx264", {"preset": "ultrafast", "g": "250"})
    io.write_mp4(path, frames, 25)
    start = time.perf_counter()
    opened = io.Video(path)
    opened[len(opened) - 1]
    assert len(opened) == 3600 and time.perf_counter() - start < 2
    assert opened._decoder._count <= 251


@pytest.mark.parametrize("degrees", [0, 90, 180, -90])
@pytest.mark.parametrize("hflip", [False, True])
def test_frames_are_turned_as_they_are_to_be_displayed(tmp_path: Path, degrees: int, hflip: bool) -> None:
    pixels = np.zeros((32, 48, 3), np.uint8)
    pixels[:16, :16], pixels[:16, 32:] = 255, (255, 0, 0)
    made = write_video(tmp_path / "a.mp4", [pixels] * 3, degrees=degrees, hflip=hflip, aspect=Fraction(5, 3))
    opened = io.Video(made)
    expected = np.rot90(pixels, degrees // 90)
    expected = expected[:, ::-1] if hflip else expected
    assert (opened.height, opened.width) == expected.shape[:2]
    assert opened.pixel_aspect == pytest.approx(5 / 3 if degrees % 180 == 0 else 3 / 5)
    assert np.abs(opened[1].astype(int) - expected).mean() < 10


def test_odd_sizes_are_padded(tmp_path: Path) -> None:
    io.write_mp4(tmp_path / "a.mp4", flat(3, 31, 47), 10)
    assert io.Video(tmp_path / "a.mp4")[2].shape == (32, 48, 3)


@pytest.mark.parametrize("name", [b"\xff\xe9.mp4", b"a:b %03d?#x.mp4", "fahrt ü.mp4".encode(), b"-y.mp4"])
def test_any_name(tmp_path: Path, name: bytes) -> None:
    for path in (tmp_path / "one" / os.fsdecode(name), tmp_path / os.fsdecode(name) / "a.mp4"):
        io.write_mp4(path, flat(5), 10)
        assert indices(io.Video(path)) == list(range(5))
        assert [file.name for file in path.parent.iterdir()] == [path.name]
        assert index_of(pickle.loads(pickle.dumps(io.Video(path)))[4]) == 4


def test_refuses_to_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"no\.mp4: no such file"):
        io.Video(tmp_path / "no.mp4")
    with pytest.raises(ValueError, match=r"text\.mp4: is not a video that FFmpeg can read"):
        io.Video(write_text(tmp_path / "text.mp4", "hello"))
    playlist = write_text(tmp_path / "list.mp4", "#EXTM3U", "#EXTINF:1,", "http://127.0.0.1:9/a.ts", "#EXT-X-ENDLIST")
    with pytest.raises(ValueError, match=r"list\.mp4: "):
        io.Video(playlist)
    made = write_video(tmp_path / "a.mp4", flat(3))
    monkeypatch.setattr(_video_packets, "MOST_PIXELS", 100)
    with pytest.raises(ValueError, match=r"a\.mp4: its header claims frames of 32 x 48 px; at most 100 pixels"):
        io.Video(made)


def test_a_damaged_frame_is_named(tmp_path: Path) -> None:
    opened = io.Video(write_video(tmp_path / "a.mkv", flat(20), gop=5))
    opened._list.pts[7] += 1  # a frame that the file does not have
    with pytest.raises(ValueError, match=r"a\.mkv: is damaged: frame 7 can't be decoded"):
        opened[7]
    assert index_of(opened[8]) == 8


def test_refuses_to_write(tmp_path: Path) -> None:
    for write, name in ((io.write_mp4, "a.mp4"), (io.write_gif, "a.gif")):
        with pytest.raises(ValueError, match="at least one frame"):
            write(tmp_path / name, [], 10)
        with pytest.raises(ValueError, match="`fps` must be positive, got 0"):
            write(tmp_path / name, flat(1), 0)
        with pytest.raises(ValueError, match=r"`frames` must be \[H, W, 3\] uint8, got float64"):
            write(tmp_path / name, [np.zeros((4, 4, 3))], 10)
        with pytest.raises(ValueError, match=r"`frames` must all be \[32, 48, 3\] uint8, got uint8 \[8, 8, 3\]"):
            write(tmp_path / name, [*flat(2), noise_image(8, 8)], 10)
        with pytest.raises(ValueError, match="must end in"):
            write(tmp_path / "a.mkv", flat(1), 10)
    assert not list(tmp_path.iterdir())


def test_browsers_play_it(clip: Path) -> None:
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    io.write_mp4(clip, flat(3), 10, pixel_aspect=1.6)
    assert io.Video(clip).pixel_aspect == 1.6
    content = clip.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # it starts before it is loaded


@pytest.fixture
def other_encoder() -> Iterator[None]:
    video_writing.encoder.cache_clear()
    yield
    video_writing.encoder.cache_clear()


@pytest.mark.usefixtures("other_encoder")
def test_without_an_encoder_of_h264(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert video_writing.encoder() == "libx264" and video_writing.encoder_note() is None
    video_writing.encoder.cache_clear()
    monkeypatch.setattr(video_writing, "ENCODERS", {"not there": {}, "mpeg4": {"qscale": "3"}})
    io.write_mp4(tmp_path / "a.mp4", flat(5), 10)
    assert indices(io.Video(tmp_path / "a.mp4")) == list(range(5))
    assert "no H.264 encoder" in (video_writing.encoder_note() or "")
    video_writing.encoder.cache_clear()
    monkeypatch.setattr(video_writing, "ENCODERS", {"not there": {}})
    with pytest.raises(ValueError, match="no encoder for MP4: none of not there"):
        io.write_mp4(tmp_path / "b.mp4", flat(5), 10)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


@contextmanager
def at_most(size: int) -> Iterator[None]:
    """No file may become larger, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("size", [0, 1000, 20_000, 60_000])
def test_a_full_disk(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")
    with at_most(size), pytest.raises(OSError, match=r"can't be written: File too large.*a\.mp4"):
        io.write_mp4(path, [noise_image(64, 96, i) for i in range(30)], 10)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]


def test_what_was_written_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(io.Video, "__len__", lambda self: self.frames - 1)
    with pytest.raises(OSError, match=r"a\.mp4"):
        io.write_mp4(tmp_path / "a.mp4", flat(5), 10)
    assert not list(tmp_path.iterdir())


def test_gif(tmp_path: Path) -> None:
    io.write_gif(tmp_path / "a.gif", iter(flat(5)), 12.5)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["loop"], image.info["duration"]) == (5, (48, 32), 0, 80)
        image.seek(4)
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - flat(5)[4]).max() <= 2
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_real_motorway() -> None:
    opened = io.Video(real("highway.mp4"))
    assert (len(opened), opened.height, opened.width, opened.fps) == (221, 540, 960, 25)
    assert opened[30].std() > 20


def test_more_frames_are_kept_if_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Back and forth over 20 frames, without going to a key frame again."""
    video = io.Video(write_video(tmp_path / "long.mp4", flat(24), gop=24))
    restarts: list[int] = []
    restart = _video_decoder.Decoder._restart
    monkeypatch.setattr(
        _video_decoder.Decoder, "_restart", lambda self, key: (restarts.append(key), restart(self, key))
    )
    order = [0, 20, 1, 21, 2, 22, 3]
    assert [index_of(video[index]) for index in order] == order
    assert restarts
    video.keep(24)
    restarts.clear()
    assert [index_of(video[index]) for index in (0, *order)] == [0, *order]
    assert len(restarts) <= 1
    video.keep(2)
    assert index_of(video[1]) == 1 and len(restarts) <= 1, "fewer are not asked for"
