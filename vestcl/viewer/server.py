"""The viewer's server: on the loopback address, and closed with the command that opened it."""

import contextlib
import io
import threading
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from vestcl.data.sample import Clip
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.viewer import camera, images
from vestcl.viewer.engine import Engine
from vestcl.viewer.page import Page
from vestcl.viewer.renderer import Job, Renderer

if TYPE_CHECKING:
    from vestcl.models.inference.quality import Quality

#: The only address that the server is bound to: the page has no password.
HOST: Final = "127.0.0.1"

#: viser's own.
PORT: Final = 8080

#: Frames per second of a camera path's video.
_FPS: Final = 20.0


def import_viser() -> Any:
    """The package viser.

    Raises:
        ValueError: it is not installed; the message has the command that does it.
    """
    try:
        import viser
    except ImportError as error:
        raise ValueError(f"the viewer needs viser ({error}): pip install 'vestcl[viewer]'") from error
    return viser


class Viewer:
    """A page that shows a clip, its future and the space in between; a context manager that closes it.

    Args:
        clip: of two frames or more.
        model: see `Engine`; None has the geometric forecast only.
        preset: of the network, to begin with.
        index: the frame t that is shown first; None is the fourth, or the last of a shorter clip.
        port: of the server; where it is taken, the next one that is free.
        inpaint: see `vestcl.scene.perception.Perception`.

    Raises:
        ValueError: no viser, a clip of one frame, no such frame, or a network that the viewer can't show.
    """

    def __init__(
        self,
        clip: Clip,
        model: str | Path | None = None,
        preset: "Quality" = "balanced",
        *,
        index: int | None = None,
        port: int = PORT,
        inpaint: Inpainter | None = None,
    ) -> None:
        viser = import_viser()
        first = min(3, len(clip) - 1) if index is None else index
        if len(clip) > 1 and not 1 <= first < len(clip):
            raise ValueError(f"`frame` must be 1 ... {len(clip) - 1}, to have a frame before it, got {first}")
        self.engine = Engine(clip, model, preset, inpaint=inpaint)
        self._ended = threading.Event()
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # viser's own table of addresses
                self.server = viser.ViserServer(host=HOST, port=port, label=f"vestcl: {clip.name}", verbose=False)
            self.page = Page(self.server, self.engine, first, preset)
        except BaseException:
            self.engine.close()
            raise
        self.renderer = Renderer(self.engine, self.page)
        self.engine.when_ready = self.renderer.ready
        self._connect()
        self.renderer.start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server.get_port()}"

    def wait(self) -> None:
        """Return when the page's button closes the viewer."""
        while not self._ended.wait(1.0):
            pass

    def close(self) -> None:
        """End the server and the threads; the page says that the connection is lost."""
        self._ended.set()
        self.renderer.close()
        self.engine.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _connect(self) -> None:
        page, server = self.page, self.server
        server.on_client_connect(self._came)
        server.on_client_disconnect(lambda client: self.renderer.remove(client.client_id))
        page.on_change(self._look_changed)
        page.home.on_click(lambda event: self._go_home(event.client))
        page.quit.on_click(lambda event: self._ended.set())
        page.add_keyframe.on_click(lambda event: self._add_keyframe(event.client))
        page.clear_keyframes.on_click(lambda event: page.forget_keyframes())
        page.save_video.on_click(lambda event: self._submit(event.client, self._video(event.client)))
        for suffix, button in page.files.items():
            button.on_click(lambda event, suffix=suffix: self._submit(event.client, self._file(event.client, suffix)))

    def _look_changed(self) -> None:
        self.engine.note_input()
        self.renderer.look_changed()

    def _came(self, client: Any) -> None:
        self._go_home(client)
        self.renderer.add(client.client_id, client)

        async def moved(handle: Any) -> None:
            self.renderer.camera_moved(client.client_id)

        client.camera.on_update(moved)

    def _go_home(self, client: Any) -> None:
        """The client's camera is the source camera."""
        if client is None:
            return
        sample = self.engine.clip[0]
        with client.atomic():
            client.camera.up_direction, client.camera.position = (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)
            client.camera.look_at = (0.0, 0.0, 10.0)
            client.camera.fov = camera.fov_of(sample.K, sample.height, sample.width, float(client.camera.aspect))
        self.renderer.camera_moved(client.client_id)

    def _add_keyframe(self, client: Any) -> None:
        current = self.renderer.current()
        visitor = None if client is None else self.renderer.visitors.get(client.client_id)
        if current is None or visitor is None:
            return
        scene, look = current
        self.page.keyframes.append(camera.Keyframe(visitor.pose(), look.ahead))
        self.page.draw_keyframes(scene)

    def _submit(self, client: Any, job: Job) -> None:
        if client is None:
            return

        def failed(message: str) -> None:
            client.add_notification("not saved", message, color="red")

        self.renderer.submit(job, failed)

    def _file(self, client: Any, suffix: str) -> Iterator[None]:
        """Send the client its view as a file."""
        yield
        current = self.renderer.current()
        visitor = self.renderer.visitors.get(client.client_id)
        if current is None or visitor is None:
            raise ValueError("no frame is shown yet")
        scene, look = current
        view = camera.view_of(visitor.pose(), scene.K, *scene.size)
        assert view.K is not None
        content = images.file_of(scene.render(look.ahead, view), view.K, suffix)
        name = f"{_file_name(self.engine.clip.name)}_t{scene.index}_{look.ahead:+.1f}{suffix}"
        client.send_file_download(name, content, save_immediately=True)

    def _video(self, client: Any) -> Iterator[None]:
        """Send the client the video of the path through the keyframes."""
        keyframes, current = list(self.page.keyframes), self.renderer.current()
        if current is None or len(keyframes) < 2:
            raise ValueError(f"a camera path needs 2 keyframes or more, got {len(keyframes)}: add keyframe")
        scene, look = current
        path, frames = camera.camera_path(keyframes, max(round(float(self.page.seconds.value) * _FPS), 2)), []
        note = client.add_notification("camera path", "rendering ...", loading=True, with_close_button=False)
        try:
            for number, key in enumerate(path, 1):
                rendered = scene.render(key.ahead, camera.view_of(key.pose, scene.K, *scene.size))
                frames.append(images.pixels_of(rendered, look.colour))
                note.body = f"{number} of {len(path)} frames"
                yield
            content = images.video_of(frames, _FPS, float(scene.K[1, 1] / scene.K[0, 0]))
            client.send_file_download(f"{_file_name(self.engine.clip.name)}_path.mp4", content, save_immediately=True)
        finally:
            note.remove()


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in name)
