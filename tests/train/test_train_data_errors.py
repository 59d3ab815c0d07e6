"""train.data.windows: what is refused, and how it is said."""

from pathlib import Path
from typing import Any, cast

import pytest
from test_train_data import HEIGHT, WIDTH, FakeClip, fakes

from train.data.windows import Draw, WindowSet, loader
from vestcl.data import Street, street_clip
from vestcl.prepare.clip import prepare_clip
from vestcl.prepare.prepared import PreparedClip, find_prepared


def test_too_short_clips_say_how_many_frames_are_needed() -> None:
    with pytest.raises(ValueError, match="`clips` must have 5 frames or more without a gap, got 4 in the longest clip"):
        fakes(3, 4, horizons=(1, 1, 1))
    with pytest.raises(ValueError, match=r"`clips` must have 3 frames or more within frames 8 \.\.\. 9 without a gap"):
        fakes(20, frames=(8, 9))
    with pytest.raises(ValueError, match="`clips` must be one or more, got none"):
        fakes()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizons": ()}, "`horizons` must be weights"),
        ({"horizons": (0.0, 0.0)}, "`horizons` must be weights"),
        ({"horizons": (1.0, -0.1)}, "`horizons` must be weights"),
        ({"colour": 1.5}, "`colour` must be 0 ... 1, got 1.5"),
        ({"right": -1}, "`right` must be 0 ... 1, got -1"),
        ({"scale": (0.5, 1.0)}, "`scale` must be 0 < low <= high <= 1, and low = high without crop"),
        ({"scale": (0.0, 1.0), "crop": (4, 4)}, "`scale` must be 0 < low"),
        ({"scale": (1.0, 2.0), "crop": (4, 4)}, "`scale` must be 0 < low"),
        ({"crop": (9, 12)}, "`crop` must lie in the frames even at scale 1, got (9, 12) for fake, which is 8x12"),
        ({"crop": (5, 6), "scale": (0.5, 1.0)}, "even at scale 0.5, got (5, 6)"),
        ({"crop": (0, 6)}, "`crop` must lie in the frames"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the message is compared as it is
        fakes(6, **settings)
    assert message in str(caught.value)


def test_several_sizes_need_a_crop() -> None:
    clips = cast(list[PreparedClip], [FakeClip(6), FakeClip(6, (16, 24))])
    with pytest.raises(ValueError, match="`crop` must be given for clips of several sizes, got 8x12 and 16x24"):
        WindowSet(clips)
    assert WindowSet(clips, crop=(4, 4)).windows


def test_a_frame_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    prepare_clip(street_clip(Street.generate(3), 4, HEIGHT, WIDTH, samples=1), tmp_path / "clip")
    windows = WindowSet(find_prepared(tmp_path))
    next(iter((tmp_path / "clip").glob("*2.safetensors"))).unlink()
    label = windows.label(Draw(0, 1, 1, False, (0,)))
    assert label == f"{windows.clips[0].name}/{windows.clips[0].frame_name(1)}"
    with pytest.raises(ValueError, match=f"^{label}: .*2.safetensors: is missing"):
        windows.batch([Draw(0, 1, 1, False, (0,))])


@pytest.mark.parametrize("workers", [0, 1])
def test_a_worker_s_error_is_a_line(tmp_path: Path, workers: int) -> None:
    prepare_clip(street_clip(Street.generate(3), 4, HEIGHT, WIDTH, samples=1), tmp_path / "clip")
    for path in (tmp_path / "clip").glob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match=r"^[^\n]*safetensors: is damaged [^\n]*; run `vestcl prepare` again$"):
        list(loader(WindowSet(find_prepared(tmp_path)), 0, 1, range(2), workers=workers))


def test_batches_that_cannot_be_shared_are_refused() -> None:
    windows = fakes(6)
    for batch, rank, world in ((3, 0, 2), (0, 0, 1), (2, 2, 2), (2, -1, 2)):
        with pytest.raises(ValueError, match="`batch` must be a multiple of"):
            loader(windows, 0, batch, range(1), rank=rank, world=world)
