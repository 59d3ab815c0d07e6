"""train.data.windows: the camera's true way, to every horizon."""

import itertools
from typing import Any, cast

import numpy as np
from geometric_scenes import turned
from numpy.typing import NDArray
from test_train_data import FakeClip

from train.data.windows import Draw, WindowSet
from vestcl.prepare.prepared import PreparedClip


class Driven(FakeClip):
    """With poses, but of the frames that are left out."""

    def __init__(self, frames: int, unknown: tuple[int, ...] = ()) -> None:
        super().__init__(frames)
        steps = [turned(0.01 * i, 0.03, -0.02, (0.1, 0.02 * i, 1.0)) for i in range(frames)]
        self.poses = list(itertools.accumulate(steps, np.matmul))
        self.unknown = unknown

    def world_from_cam(self, index: int) -> Any:
        return None if index in self.unknown else self.poses[index]


def driven(*unknown: int, **settings: Any) -> tuple[Driven, WindowSet]:
    clip = Driven(8, unknown)
    return clip, WindowSet(cast(list[PreparedClip], [clip]), horizons=(0.5, 0.3, 0.2), **settings)


def test_the_path_is_that_of_the_poses() -> None:
    """To t + 1, t + 2 and t + 3, whichever of them is the target."""
    clip, windows = driven()
    for horizon in (1, 3):
        batch = windows.batch([Draw(0, 2, horizon, False, (0,)), Draw(0, 4, horizon, False, (0,))])
        assert batch.path_from_cur.shape == (2, 3, 4, 4) and batch.pose_known.all()
        for path, t in zip(batch.path_from_cur.double().numpy(), (2, 4), strict=True):
            for k, future_from_cur in enumerate(path, start=1):
                np.testing.assert_allclose(clip.poses[t + k] @ future_from_cur, clip.poses[t], rtol=0, atol=1e-5)
        np.testing.assert_array_equal(batch.path_from_cur[:, horizon - 1], batch.future_from_cur)


def test_a_mirrored_window_has_the_mirrored_path() -> None:
    mirror = np.diag([-1.0, 1, 1, 1])
    _, plain = driven()
    _, mirrored = driven(flip=True)
    draws = [Draw(0, 3, 2, False, (seed,)) for seed in range(6)]

    def paths(windows: WindowSet) -> NDArray[np.float64]:
        return np.asarray(windows.batch(draws).path_from_cur.double().numpy(), np.float64)

    turns = [
        np.array_equal(one, mirror @ other @ mirror)
        for one, other in zip(paths(mirrored), paths(plain), strict=True)
        if not np.array_equal(one, other)
    ]
    assert 0 < len(turns) < len(draws) and all(turns)


def test_a_path_with_a_gap_is_unknown() -> None:
    """Frame 6 has no pose: windows that end before it or begin after it know theirs, all others say that they don't."""
    _, windows = driven(6)
    batch = windows.batch([Draw(0, t, 1, False, (0,)) for t in (2, 3, 4)])
    assert batch.pose_known.tolist() == [True, False, False]
    assert np.array_equal(batch.path_from_cur[1:], np.broadcast_to(np.eye(4), (2, 3, 4, 4)))
    assert not np.array_equal(batch.path_from_cur[0, 0], np.eye(4))
