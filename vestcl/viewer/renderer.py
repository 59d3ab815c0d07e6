"""The thread that renders: coarse images while a camera moves, a full one when it is still, then panels and files."""

import collections
import contextvars
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from vestcl.viewer import camera, images
from vestcl.viewer.engine import Engine, Wanted
from vestcl.viewer.scene import Scene

#: Seconds without a movement from which on a camera is still.
STILL: Final = 0.4

#: Seconds without a movement before the panels are rendered.
_PANELS_STILL: Final = 1.0

#: Coarse images have each n-th row and column: n of the finest, and of the coarsest.
_STRIDES: Final = (2, 4)

#: Seconds that a coarse image may take; faster than the second, and the next is finer.
_SLOW, _FAST = 0.075, 0.025

_LOG: Final = logging.getLogger(__name__)

Job = Iterator[None]
"""Work in pieces: between two of them cameras are served."""


class Look(NamedTuple):
    """What the page's controls say."""

    wanted: Wanted
    ahead: float
    """Intervals after t."""
    colour: str
    """One of `vestcl.viewer.images.COLOURS`."""
    image: bool
    """Whether the rendered image is shown."""


class Screen(Protocol):
    """What the renderer draws on: the page."""

    def look(self) -> Look:
        """What its controls say now."""

    def show_scene(self, scene: Scene, look: Look) -> None:
        """Cameras, points and velocities."""

    def show_panels(self, images: dict[str, NDArray[np.uint8]]) -> None:
        """The panels' images, by name."""

    def show_status(self, text: str) -> None:
        """A line on what is being done."""


class Visitor:
    """One open page.

    Args:
        client: viser's handle of it.
    """

    def __init__(self, client: Any) -> None:
        self.client = client
        self.moved_at = 0.0
        self.coarse_due = self.full_due = True

    def pose(self) -> camera.Pose:
        """Its camera now."""
        found = self.client.camera
        wxyz, position = ([float(value) for value in numbers] for numbers in (found.wxyz, found.position))
        return camera.Pose((*wxyz,), (*position,), float(found.fov), float(found.aspect))  # type: ignore[arg-type]


class Renderer:
    """Serves all visitors from one thread: who moves comes first, then jobs, then full images, then the panels.

    Args:
        engine: of the clip.
        screen: the page.
    """

    def __init__(self, engine: Engine, screen: Screen) -> None:
        self.engine, self.screen = engine, screen
        self.visitors: dict[int, Visitor] = {}
        self._jobs: collections.deque[tuple[Job, Callable[[str], None]]] = collections.deque()
        self._panels_due = self._scene_due = True
        self._scene: Scene | None = None
        self._stride = _STRIDES[0]
        self._changed = threading.Condition()
        self._closed = False
        here = contextvars.copy_context()  # which has the OpenCL device that was chosen
        self._thread = threading.Thread(target=here.run, args=(self._run,), name="vestcl view: render", daemon=True)

    def start(self) -> None:
        """Begin to render."""
        self._thread.start()

    def close(self) -> None:
        """End the thread, after the image that it renders."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def add(self, key: int, client: Any) -> Visitor:
        """A page was opened."""
        with self._changed:
            self.visitors[key] = Visitor(client)
            self._changed.notify_all()
            return self.visitors[key]

    def remove(self, key: int) -> None:
        """A page was closed."""
        with self._changed:
            self.visitors.pop(key, None)

    def camera_moved(self, key: int) -> None:
        """A visitor's camera is somewhere else."""
        self.engine.note_input()
        with self._changed:
            if visitor := self.visitors.get(key):
                visitor.moved_at, visitor.coarse_due, visitor.full_due = time.monotonic(), True, True
            self._changed.notify_all()

    def ready(self, what: Wanted | int) -> None:
        """A scene is prepared, or a true frame (its number) read."""
        if isinstance(what, int):
            with self._changed:
                self._panels_due = True
        elif what == self.screen.look().wanted:
            self.look_changed()

    def look_changed(self) -> None:
        """The controls say something else."""
        with self._changed:
            for visitor in self.visitors.values():
                visitor.moved_at, visitor.coarse_due, visitor.full_due = time.monotonic(), True, True
            self._panels_due = self._scene_due = True
            self._changed.notify_all()

    def submit(self, job: Job, failed: Callable[[str], None]) -> None:
        """Do ``job`` in pieces while no camera moves; ``failed`` is called with an error's message."""
        with self._changed:
            self._jobs.append((job, failed))
            self._changed.notify_all()

    def current(self) -> tuple[Scene, Look] | None:
        """The scene that is shown, and the controls; None before the first is ready."""
        return None if self._scene is None else (self._scene, self.screen.look())

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._closed:
                    return
            try:
                done = self._step()
            except Exception as error:  # a page that was closed meanwhile, or one view's failure: the others go on
                _LOG.warning("a view was not shown: %s", error)
                done = True
            if not done:
                with self._changed:
                    if not self._closed:
                        self._changed.wait(STILL / 4)

    def _step(self) -> bool:
        """The most urgent piece of work; False where there is none."""
        look = self.screen.look()
        scene = self._update_scene(look)
        if scene is None:
            return False
        with self._changed:
            visitors = list(self.visitors.values())
        now = time.monotonic()
        if moving := next((visitor for visitor in visitors if visitor.coarse_due), None):
            self._show_coarse(scene, look, moving)
            return True
        if self._scene_due:
            self._scene_due = False
            self.screen.show_scene(scene, look)
            return True
        still = (visitor for visitor in visitors if visitor.full_due and now - visitor.moved_at >= STILL)
        if waiting := next(still, None):
            self._show_full(scene, look, waiting)
            return True
        if self._jobs:
            self._do_job()
            return True
        if self._panels_due and visitors and all(now - visitor.moved_at >= _PANELS_STILL for visitor in visitors):
            self._panels_due = False
            self.screen.show_panels(self._panels(scene, look))
            return True
        return False

    def _update_scene(self, look: Look) -> Scene | None:
        """The scene that the controls ask for, or until it is ready the one before."""
        scene = self.engine.scene(look.wanted)
        if scene is None:
            fault = self.engine.fault(look.wanted)
            frame = f"frame {look.wanted.frame}"
            self.screen.show_status(f"{frame}: {fault}" if fault else f"computing {frame} ...")
        elif scene is not self._scene:
            self._scene, self._scene_due, self._panels_due = scene, True, True
            self.screen.show_status("; ".join((f"frame {scene.index}, {scene.motion.method}", *scene.motion.notes)))
        return self._scene

    def _show_coarse(self, scene: Scene, look: Look, visitor: Visitor) -> None:
        visitor.coarse_due = False
        start, pose = time.perf_counter(), visitor.pose()
        view = camera.view_of(pose, scene.K, *scene.size)
        if not look.image:
            visitor.client.scene.set_background_image(None)
            return
        rendered = scene.render_coarse(look.ahead, view, self._stride)
        self._send(visitor, scene, images.pixels_of(rendered, look.colour), pose, "jpeg")
        taken, (finest, coarsest) = time.perf_counter() - start, _STRIDES
        if taken > _SLOW:
            self._stride = min(self._stride + 1, coarsest)
        elif taken < _FAST:
            self._stride = max(self._stride - 1, finest)

    def _show_full(self, scene: Scene, look: Look, visitor: Visitor) -> None:
        visitor.full_due = False
        if not look.image:
            return
        pose = visitor.pose()
        rendered = scene.render(look.ahead, camera.view_of(pose, scene.K, *scene.size))
        self._send(visitor, scene, images.pixels_of(rendered, look.colour), pose, "png")

    def _send(self, visitor: Visitor, scene: Scene, image: NDArray[np.uint8], pose: camera.Pose, kind: str) -> None:
        with self._changed:
            if visitor not in self.visitors.values():  # closed meanwhile
                return
        shape = float(scene.K[1, 1] / scene.K[0, 0])
        visitor.client.scene.set_background_image(camera.on_canvas(image, pose.aspect, shape), format=kind)
        visitor.client.flush()

    def _panels(self, scene: Scene, look: Look) -> dict[str, NDArray[np.uint8]]:
        """Of the source camera."""
        rendered = scene.render(look.ahead, camera.SOURCE)
        return images.panels(rendered, self.engine.truth(scene.index, look.ahead))

    def _do_job(self) -> None:
        with self._changed:
            job, failed = self._jobs[0]
        try:
            next(job)
        except StopIteration:
            self._jobs.popleft()
        except Exception as error:
            self._jobs.popleft()
            failed(str(error) or repr(error))
