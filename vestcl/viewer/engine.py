"""The scenes of a clip: prepared in a thread of their own, nearest first, and kept."""

import collections
import contextvars
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vestcl.constants import WORK_WIDTH
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric.forecast import METHOD
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.scene.perception import Perception
from vestcl.viewer.motion import check_model, geometric_motion, network_motion
from vestcl.viewer.scene import Scene

if TYPE_CHECKING:
    from vestcl.models.forecaster import Forecaster
    from vestcl.models.inference.quality import Quality

#: Scenes that are kept: one takes about 60 MB at 256 x 832.
_KEPT: Final = 12

#: Frames next to the wanted one that are prepared while nothing else is to be done.
_AHEAD_OF_NEED: Final = (1, -1, 2, 3)

#: Seconds without input before frames are prepared ahead of need.
_IDLE: Final = 1.0

_LOG: Final = logging.getLogger(__name__)


class Wanted(NamedTuple):
    """What a scene is of."""

    frame: int
    """The frame t."""
    method: str
    """`METHOD`, or a network's name."""
    preset: "Quality"
    """Of the network."""


class Engine:
    """Scenes by frame, method and preset. One thread prepares them; `scene` never waits.

    Args:
        clip: of two frames or more.
        model: a network that corrects the geometric forecast, see `vestcl.models.inference.quality.load`; None has the
            geometric forecast only.
        preset: of the network, to begin with.
        inpaint: see `Perception`.
        when_ready: called with a scene that was prepared, or failed, or with the number of a true frame that was read.

    Raises:
        ValueError: a clip of one frame, no such network, or one that forecasts by itself.
    """

    def __init__(
        self,
        clip: Clip,
        model: str | Path | None = None,
        preset: "Quality" = "balanced",
        *,
        inpaint: Inpainter | None = None,
        when_ready: Callable[[Wanted | int], None] = lambda ready: None,
    ) -> None:
        if len(clip) < 2:
            raise ValueError(f"{clip.name}: must have 2 frames or more, got {len(clip)}")
        self.clip, self.when_ready = clip, when_ready
        self._model = model
        self._models: dict[str, Forecaster] = {}
        self.methods: tuple[str, ...] = (METHOD,)
        if model is not None:
            self.methods = (METHOD, self._network(preset).config.name)
        self._perception = Perception(clip, inpaint=inpaint, work_width=WORK_WIDTH)
        self._scenes: collections.OrderedDict[Wanted, Scene] = collections.OrderedDict()
        self._truths: collections.OrderedDict[int, NDArray[np.float32]] = collections.OrderedDict()
        self._failed: dict[Wanted, str] = {}
        self._wanted: Wanted | None = None
        self._unread: int | None = None
        self._active, self._closed = 0.0, False
        self._changed = threading.Condition()
        here = contextvars.copy_context()  # which has the OpenCL device that was chosen
        self._thread = threading.Thread(
            target=here.run, args=(self._prepare_all,), name="vestcl view: prepare", daemon=True
        )
        self._thread.start()

    def scene(self, wanted: Wanted) -> Scene | None:
        """The scene if it is ready, else None: it is prepared next."""
        with self._changed:
            if wanted != self._wanted:
                self._wanted = wanted
                self._changed.notify_all()
            if wanted in self._scenes:
                self._scenes.move_to_end(wanted)
            return self._scenes.get(wanted)

    def fault(self, wanted: Wanted) -> str | None:
        """Why a scene can't be prepared; None where it can."""
        with self._changed:
            return self._failed.get(wanted)

    def note_input(self) -> None:
        """The user is at work: nothing is prepared ahead of need for a second."""
        self._active = time.monotonic()

    def truth(self, index: int, ahead: float) -> NDArray[np.float32] | None:
        """The true image [3, H, W] of frame ``index`` + ``ahead``; None where there is none, or where it is still to be
        read: that is done next."""
        frame = self._true_frame(index, ahead)
        if frame is None:
            return None
        with self._changed:
            if frame not in self._truths:
                self._unread = frame
                self._changed.notify_all()
            return self._truths.get(frame)

    def _true_frame(self, index: int, ahead: float) -> int | None:
        steps = round(ahead)
        if steps != ahead:
            return None
        if steps <= 0:
            return index + steps
        after = self.clip.after(index, steps)
        return after[steps - 1] if len(after) == steps else None

    def close(self) -> None:
        """End the thread, after the scene that it prepares."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _network(self, preset: "Quality") -> "Forecaster":
        from vestcl.models.inference import quality

        assert self._model is not None
        if preset not in self._models:
            model = quality.load(self._model, preset)
            check_model(model, str(self._model))
            self._models[preset] = model
        return self._models[preset]

    def _prepare_all(self) -> None:
        while True:
            with self._changed:
                wanted = self._next()
                while wanted is None and not self._closed:
                    self._changed.wait(_IDLE / 2)
                    wanted = self._next()
                if self._closed or wanted is None:
                    return
            if isinstance(wanted, int):
                self._read_truth(wanted)
            else:
                self._prepare(wanted)
            self.when_ready(wanted)

    def _next(self) -> Wanted | int | None:
        """The wanted scene, or where it is there a true frame, or a scene next to it."""
        if self._wanted is None:
            return None
        if self._unread is not None and (self._wanted in self._scenes or self._wanted in self._failed):
            return self._unread
        idle = time.monotonic() - self._active > _IDLE
        for step in (0, *(_AHEAD_OF_NEED if idle else ())):
            each = self._wanted._replace(frame=self._wanted.frame + step)
            if 1 <= each.frame < len(self.clip) and each not in self._scenes and each not in self._failed:
                return each
        return None

    def _read_truth(self, frame: int) -> None:
        try:
            image = self.clip[frame].read_image().copy()
        except (OSError, ValueError) as error:
            _LOG.warning("frame %d has no true image: %s", frame, error)
            image = np.zeros((3, self.clip[0].height, self.clip[0].width), np.float32)
        with self._changed:
            self._truths[frame], self._unread = image, None
            while len(self._truths) > _KEPT:
                self._truths.popitem(last=False)

    def _prepare(self, wanted: Wanted) -> None:
        try:
            scene = self._made(wanted)
        except Exception as error:  # one frame's failure must not end the viewer
            with self._changed:
                self._failed[wanted] = str(error) or repr(error)
            return
        with self._changed:
            self._scenes[wanted] = scene
            if self._wanted is not None and self._wanted in self._scenes:
                self._scenes.move_to_end(self._wanted)
            while len(self._scenes) > _KEPT:
                self._scenes.popitem(last=False)

    def _made(self, wanted: Wanted) -> Scene:
        if wanted.method == METHOD:
            motion = geometric_motion(self._perception, wanted.frame)
        else:
            motion = network_motion(self._perception, wanted.frame, self._network(wanted.preset))
        return Scene(self._perception, wanted.frame, motion)
