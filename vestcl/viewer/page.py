"""The page: its controls, and what is drawn in 3D."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from vestcl.viewer import camera, images
from vestcl.viewer.engine import Engine, Wanted
from vestcl.viewer.motion import MOST_AHEAD, TICKS, Matrix
from vestcl.viewer.renderer import Look
from vestcl.viewer.scene import Scene

if TYPE_CHECKING:
    from vestcl.models.inference.quality import Quality

#: RGB of the frusta of past, forecast and true cameras, of keyframes, and of velocities.
_PAST, _FORECAST, _TRUE = (130, 130, 130), (255, 140, 0), (0, 170, 80)
_KEYFRAME, _VELOCITY = (60, 120, 255), (230, 30, 60)

#: Metres: the depth of a frustum that is drawn.
_FRUSTUM: Final = 0.15

_PANELS: Final = ("truth", "error", "depth", "coverage")


class Page:
    """Controls that all visitors share, and the scene in 3D.

    Args:
        server: viser's.
        engine: of the clip.
        index: the frame t that is shown first.
        preset: of the network, shown first.
    """

    def __init__(self, server: Any, engine: Engine, index: int, preset: "Quality") -> None:
        self._server, self._engine = server, engine
        self.keyframes: list[camera.Keyframe] = []
        theme = {"show_share_button": False, "show_logo": False, "dark_mode": True}  # shared pages leave this machine
        server.gui.configure_theme(**theme)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction("-y")
        server.scene.configure_environment_map(None)  # without a graphics card it and shadows take most of the time
        server.scene.configure_default_lights(cast_shadow=False)
        server.scene.add_light_ambient("/light", intensity=2.0)
        self._add_camera(engine)
        self._status = server.gui.add_markdown("")
        self._add_time(index)
        self._add_method(preset)
        self._add_panels()
        self._add_paths()
        self._add_files()
        self._world = server.scene.add_frame("/t", show_axes=False)
        self._drawn: tuple[Any, ...] = ()

    def _add_camera(self, engine: Engine) -> None:
        first = engine.clip[0]
        start = self._server.initial_camera
        start.up, start.position, start.look_at = (0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 10.0)
        start.fov = camera.fov_of(first.K, first.height, first.width, 16 / 9)

    def _add_time(self, index: int) -> None:
        gui, last = self._server.gui, len(self._engine.clip) - 1
        with gui.add_folder("Time"):
            self.frame = gui.add_slider("frame t", min=1, max=max(last, 1), step=1, initial_value=index)
            self.ahead = gui.add_slider(
                "intervals ahead", min=-1.0, max=float(MOST_AHEAD), step=1 / TICKS, initial_value=0.0
            )

    def _add_method(self, preset: "Quality") -> None:
        from vestcl.models.inference.quality import LEVELS

        gui, methods = self._server.gui, self._engine.methods
        with gui.add_folder("Show"):
            self.method = gui.add_dropdown("method", methods, initial_value=methods[-1])
            self.preset = gui.add_dropdown("preset", LEVELS, initial_value=preset, disabled=len(methods) == 1)
            self.colour = gui.add_dropdown("colours", images.COLOURS)
            self.image = gui.add_checkbox("image", initial_value=True)
            self.cameras = gui.add_checkbox("cameras", initial_value=True)
            self.velocities = gui.add_checkbox("velocities", initial_value=True)
            self.points = gui.add_checkbox("3D points", initial_value=False)
            self.home = gui.add_button("source camera")

    def _add_panels(self) -> None:
        gui, black = self._server.gui, np.zeros((8, 26, 3), np.uint8)
        with gui.add_folder("Source camera"):
            self.panels = {name: gui.add_image(black, label=name) for name in _PANELS}

    def _add_paths(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Camera path"):
            self.add_keyframe = gui.add_button("add keyframe")
            self.clear_keyframes = gui.add_button("clear keyframes")
            self.seconds = gui.add_number("seconds", initial_value=3.0, min=0.5, max=60.0, step=0.5)
            self.save_video = gui.add_button("save video")

    def _add_files(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Save"):
            self.files = {suffix: gui.add_button(suffix[1:].upper()) for suffix in (".png", ".exr", ".ply")}
        self.quit = gui.add_button("close the viewer")

    def on_change(self, changed: Callable[[], None]) -> None:
        """Call ``changed`` when the user changes a control."""
        controls = self.frame, self.ahead, self.method, self.preset, self.colour, self.image
        for control in (*controls, self.cameras, self.velocities, self.points):
            control.on_update(lambda _: changed())

    def look(self) -> Look:
        """What its controls say now."""
        wanted = Wanted(int(self.frame.value), self.method.value, self.preset.value)
        return Look(wanted, float(self.ahead.value), self.colour.value, bool(self.image.value))

    def show_status(self, text: str) -> None:
        """A line on what is being done."""
        if self._status.content != text:
            self._status.content = text

    def show_panels(self, images: dict[str, NDArray[np.uint8]]) -> None:
        """The panels' images, by name."""
        for name, image in images.items():
            self.panels[name].image = image

    def show_scene(self, scene: Scene, look: Look) -> None:
        """Cameras, points and velocities, each as its box is ticked."""
        next_from_cur = scene.motion.camera(look.ahead)
        self._world.position, self._world.wxyz = next_from_cur[:3, 3], camera.quaternion_of(next_from_cur)
        shown = bool(self.cameras.value), bool(self.points.value), bool(self.velocities.value)
        drawn = (scene, look.ahead, *shown, len(self.keyframes))
        if drawn == self._drawn:
            return
        with self._server.atomic():
            if self._drawn[:1] != drawn[:1]:
                self._draw_cameras(scene)
            self._world.visible = shown[0]
            self._draw_points(scene, look.ahead, shown[1])
            self._draw_velocities(scene, look.ahead, shown[2])
        self._drawn = drawn

    def draw_keyframes(self, scene: Scene) -> None:
        """The cameras that were chosen for a path, each in place at its time."""
        with self._server.atomic():
            for number, key in enumerate(self.keyframes):
                turn = np.linalg.inv(camera.view_of(key.pose, scene.K, *scene.size).tgt_from_next)
                cur_from_key = np.linalg.inv(scene.motion.camera(key.ahead)) @ turn
                self._frustum(f"/t/keyframes/{number}", scene, cur_from_key, _KEYFRAME)

    def forget_keyframes(self) -> None:
        """Remove all."""
        self.keyframes.clear()
        self._server.scene.add_frame("/t/keyframes", show_axes=False).remove()

    def _draw_cameras(self, scene: Scene) -> None:
        self._server.scene.add_frame("/t/cameras", show_axes=False).remove()
        self._server.scene.add_frame("/t/cameras", show_axes=False)
        paths = scene.cameras
        kinds = (("past", paths.past, _PAST), ("forecast", paths.forecast, _FORECAST), ("true", paths.true, _TRUE))
        for name, poses, colour in kinds:
            for number, pose in enumerate(poses):
                self._frustum(f"/t/cameras/{name}/{number}", scene, pose, colour)

    def _frustum(self, name: str, scene: Scene, cur_from_cam: Matrix, colour: tuple[int, int, int]) -> None:
        height, width = scene.size
        self._server.scene.add_camera_frustum(
            name,
            fov=2 * float(np.arctan(height / (2 * scene.K[1, 1]))),
            aspect=float(width * scene.K[1, 1] / (height * scene.K[0, 0])),
            scale=_FRUSTUM,
            thickness=1.5,
            thickness_units="screen",
            color=colour,
            wxyz=camera.quaternion_of(cur_from_cam),
            position=cur_from_cam[:3, 3],
        )

    def _draw_points(self, scene: Scene, ahead: float, visible: bool) -> None:
        points, colours = scene.points(ahead) if visible else (np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))
        self._server.scene.add_point_cloud(
            "/points", points, colours, point_size=0.04, precision="float32", point_shading="flat", visible=visible
        )

    def _draw_velocities(self, scene: Scene, ahead: float, visible: bool) -> None:
        arrows = scene.velocities(ahead)
        there = visible and len(arrows) > 0
        ends = arrows if len(arrows) else np.zeros((1, 2, 3), np.float32)
        thick = {"shaft_radius": 0.05, "head_radius": 0.15, "head_length": 0.3}
        self._server.scene.add_arrows("/velocities", ends, _VELOCITY, visible=there, **thick)
