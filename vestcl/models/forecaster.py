"""The whole network: two frames in, future frames out, from any camera."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import nn

from vestcl.models._checkpoint import read_checkpoint, write_checkpoint
from vestcl.models._clouds import Cloud, advance, as_image, join, lift, lift_hidden
from vestcl.models._encode import Memory, encode, version
from vestcl.models._frames import EncodedFrame, check_frames, grid_depth, grid_mean, with_depth
from vestcl.models._motion import INTERVALS, Motion, Step, arrived, next_prior
from vestcl.models._objects import move_objects, unmoved
from vestcl.models._perceive import Perceive, known_view, perceive_forecast, perceive_view
from vestcl.models._render import (
    Camera,
    RenderedView,
    Side,
    checked_camera,
    compose_view,
    refined_channels,
    splat_cloud,
)
from vestcl.models.config import OPAQUE, ModelConfig
from vestcl.models.ego_motion import CameraMotion, EgoMotion, RigidMotion
from vestcl.models.encoder import Encoder
from vestcl.models.object_motion import ObjectMotion, ObjectMotionForecast
from vestcl.models.prior import MotionPrior, beside, check_prior
from vestcl.models.refine import Refine
from vestcl.models.skipping import Skip, Tally
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject
from vestcl.scene.layers import LayerBatch

__all__ = ["Camera", "Forecaster", "Mode", "Motion", "Perceive", "RenderedView", "Step", "perceive_forecast"]

Mode = Literal["feedback", "compose"]
Views = Sequence[tuple[torch.Tensor, torch.Tensor]]


class Forecaster(nn.Module):
    """Encode, lift, forecast the camera's and then the objects' motion, displace, splat, refine.

    Both input frames become a cloud each: every pixel, and where foreground hides the background that is inpainted
    behind it. Inpainted points move with the static world, all others as object motion says. Both clouds go to t + 1
    directly, and are splatted there into every camera that is asked for.

    Args:
        config: sizes and choices; `vestcl.models.configuration` knows some by name.

    Source: SPEC sections 3 to 6; the paper's overview figure.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config, features = config, config.encoder.features
        self.encoder = Encoder(config.encoder)
        self.ego_motion = None if config.ego_motion is None else EgoMotion(config.ego_motion, features, config.start)
        self.object_motion = None if config.object_motion is None else ObjectMotion(config.object_motion, features)
        self.refine = Refine(config.refine, config.render, features)
        #: Encoder and refinement compute in this type (torch.bfloat16, or None for the parameters' own): motion, which
        #: is millimetres in hundreds of metres, never does.
        self.autocast: torch.dtype | None = None
        #: What is not computed where a scene does not need it, and how much that has been so far.
        self.skip, self.tally = Skip(), Tally()
        self._memory = Memory()

    def forward(
        self,
        frame_prev: LayerBatch,
        frame_cur: LayerBatch,
        K: torch.Tensor,
        views: Views | None = None,
        *,
        prior: MotionPrior | None = None,
        horizon: int = 1,
    ) -> Step:
        """Frame t + ``horizon``, motion composed, with everything that a loss needs; arguments as of `forecast`."""
        last = {"mode": "compose", "shown": (horizon,), "prior": prior}
        return self.forecast(frame_prev, frame_cur, K, horizon, views, **last)[-1]  # type: ignore[arg-type]

    def forecast(
        self,
        frame_prev: LayerBatch,
        frame_cur: LayerBatch,
        K: torch.Tensor,
        steps: int = 1,
        views: Views | None = None,
        mode: Mode = "feedback",
        perceive: Perceive | None = None,
        *,
        prior: MotionPrior | None = None,
        shown: Collection[int] | None = None,
    ) -> list[Step]:
        """Forecast t + 1 to t + steps.

        Args:
            frame_prev: B frames at t - 1; depths above 0, all of one size.
            frame_cur: the same at t.
            K: [B, 3, 3] px, of both.
            steps: number of future frames.
            views: the cameras to show, as (tgt_from_next [B, 4, 4], K [B, 3, 3]), each at its own future time; None
                is the source camera alone; none at all forecasts motion, with "compose" alone.
            mode: "feedback" takes each forecast frame, as the source camera sees it, for an input of the next step;
                no gradient passes from step to step. "compose" encodes nothing anew: the camera goes on as was forecast
                at t, and repeats its last motion beyond that; things repeat in the world what they did beside it.
            perceive: for "feedback", (image [B, 3, H, W], depth [B, 1, H, W] m with 0 = unknown, mask [B, 1, H, W])
                -> layers of that forecast frame; None is `perceive_forecast`.
            prior: motion that was measured, for models that start from it and no others; with "feedback" each later
                step starts from the motion of the step before.
            shown: steps k to show, of 1 ... steps; None shows all.

        Returns:
            One `Step` a future frame; differentiable in parameters and images.

        Raises:
            ValueError: an argument of another shape, a depth that is not above 0, less than one step, another mode,
                or a prior that is missing or not wanted.
        """
        self._check(frame_prev, frame_cur, K, prior)
        if steps < 1 or mode not in ("feedback", "compose"):
            raise ValueError(f'`steps` must be >= 1 and `mode` "feedback" or "compose", got {steps} and {mode!r}')
        straight = Camera(torch.eye(4).to(K).expand(len(K), 4, 4), K)
        cameras = [straight] if views is None else [checked_camera(camera, len(K)) for camera in views]
        prev, cur = self.encode(frame_prev), self.encode(frame_cur)
        motion = self.move(prev, cur, K, prior)
        clouds = self.lift(prev, cur, motion, K) if cameras else []
        done, shown = list[Step](), set(range(1, steps + 1) if shown is None else shown)
        future_from_cur, path_from_cur = motion.rigid, motion.path(steps)
        while True:
            step = len(done) + 1
            seen = self._show_all(clouds, cameras, motion, K) if step in shown else []
            done.append(Step(seen, motion, future_from_cur, path_from_cur))
            if step == steps:
                return done
            if mode == "compose":
                motion = motion.following()
                clouds = [advance(cloud, motion.rigid) for cloud in clouds]
            else:
                looked = known_view(cameras, seen, straight) if seen else None
                view = looked or self.show(clouds, straight, motion, K)
                prior = None if prior is None else next_prior(prior, motion, view, K)
                prev, cur = cur, self.encode(perceive_view(view, perceive or perceive_forecast))
                motion = self.move(prev, cur, K, prior)
                clouds = self.lift(prev, cur, motion, K)
            future_from_cur = motion.rigid @ future_from_cur

    def present(
        self, frame_prev: LayerBatch, frame_cur: LayerBatch, K: torch.Tensor, views: Views, prior: MotionPrior | None
    ) -> list[RenderedView]:
        """Frame t itself from other cameras: what t shows stays where it is, and what t - 1 shows comes to t.

        cur_from_prev is the prior's, or else the network's, next_from_cur^-1 next_from_prev.

        Args:
            frame_prev: B frames at t - 1.
            frame_cur: the same at t.
            K: [B, 3, 3] px, of both.
            views: the cameras to show, as (tgt_from_cur [B, 4, 4], K [B, 3, 3]).
            prior: as of `forecast`.

        Returns:
            A view a camera; differentiable.

        Raises:
            ValueError: as `forecast`.
        """
        self._check(frame_prev, frame_cur, K, prior)
        cameras = [checked_camera(camera, len(K)) for camera in views]
        prev, cur = self.encode(frame_prev), self.encode(frame_cur)
        motion = arrived(prev, cur, K, self.move_camera(prev, cur, prior) if prior is None else prior)
        clouds = self.lift(prev, cur, motion, K)
        return self._show_all(clouds, cameras, motion, K)

    # ---------------------------------------------------------------- the figure, from left to right

    def encode(self, frame: LayerBatch) -> EncodedFrame:
        """Features of a frame and of its background, in one pass; backgrounds without foreground in front are the
        frame itself.

        Args:
            frame: layers of B frames.

        Returns:
            Features [B, C, H, W], and depths replaced where the configuration fixes them.
        """
        layers = with_depth(frame, self.config.fixed_depth)
        key = None if torch.is_grad_enabled() else self._encoding()
        known = None if key is None else self._memory.find(key, frame)
        if key is not None:
            self.tally.add("seen", len(frame.image) * (known is not None), len(frame.image), "frames")
        if known is not None:
            return known
        with self._autocast():
            encoded = encode(self.encoder, self.config.encoder, layers, self.skip, self.tally)
        if key is not None:
            self._memory.keep(key, frame, encoded)
        return encoded

    def move(self, prev: EncodedFrame, cur: EncodedFrame, K: torch.Tensor, prior: MotionPrior | None = None) -> Motion:
        """The camera's motion from both frames to the next, the rigid flow that it makes, and the objects' flow.

        Args:
            prev: frame at t - 1.
            cur: frame at t.
            K: [B, 3, 3] px.
            prior: what both start from.

        Returns:
            `Motion`; differentiable.
        """
        to_next = self.move_camera(prev, cur, prior)
        flows = [
            rigid_flow(unproject(frame.layers.depth, K), *rigid)
            for frame, rigid in zip((prev, cur), to_next[:2], strict=True)
        ]
        flow0 = as_image(torch.cat(flows, dim=2), *cur.features.shape[2:])
        start = flow0 if prior is None or self.object_motion is None else flow0 + beside(prior, to_next[:2])
        return Motion(*to_next, flow0, start, self.move_objects(prev, cur, to_next, flow0, start))

    def move_camera(self, prev: EncodedFrame, cur: EncodedFrame, prior: MotionPrior | None = None) -> CameraMotion:
        """EMF on the encoder's grid: the camera's motion; rest where the model has no EMF."""
        if self.ego_motion is None:
            return CameraMotion(*2 * (RigidMotion.rest(cur.features),))
        frames = prev, cur
        return self.ego_motion(
            *(frame.background_grid for frame in frames),
            *(grid_depth(frame.layers.background_depth) for frame in frames),
            *(grid_mean(frame.layers.mask) for frame in frames),
            prior=None if prior is None else (prior.next_from_cur, prior.cur_from_prev, prior.prev_from_before),
        )

    def move_objects(
        self,
        prev: EncodedFrame,
        cur: EncodedFrame,
        to_next: CameraMotion,
        flow0: torch.Tensor,
        start: torch.Tensor,
    ) -> ObjectMotionForecast:
        """OMF at full size, [B, 6, H, W] m in and out; ``start`` is what it corrects."""
        if self.object_motion is None or self.object_motion.changes_nothing:
            return unmoved(start)
        return move_objects(self.object_motion, prev, cur, to_next, flow0, start, self.skip, self.tally)

    def lift(self, prev: EncodedFrame, cur: EncodedFrame, motion: Motion, K: torch.Tensor) -> list[Cloud]:
        """Both frames' layers as clouds on their way to t + 1; with `RenderConfig.joint` as one.

        Args:
            prev: frame at t - 1.
            cur: frame at t.
            motion: of both.
            K: [B, 3, 3] px.

        Returns:
            Both frames' points, packed: N = H W + |M = 0| an image and frame, or as `RenderConfig.inpainted` says.
        """
        rigid, render = (motion.next_from_prev, motion.next_from_cur), self.config.render
        flows, flows0 = motion.objects.flow.split(3, dim=1), motion.flow0.split(3, dim=1)
        of_prev, of_cur = (lift(*arguments, K) for arguments in zip((prev, cur), flows, flows0, INTERVALS, strict=True))
        behind_cur = lift_hidden(cur, rigid[1], K)
        if render.inpainted == "last":
            clouds = [join(of_prev, behind_cur), of_cur]
        else:
            clouds = [join(of_prev, lift_hidden(prev, rigid[0], K)), join(of_cur, behind_cur)]
        return [join(*clouds)] if render.joint else clouds

    def show(self, clouds: Sequence[Cloud], camera: Camera, motion: Motion, K: torch.Tensor) -> RenderedView:
        """Splat each cloud into a camera, and paint the image.

        Args:
            clouds: from `lift`.
            camera: where the view is taken from.
            motion: that the clouds came by.
            K: [B, 3, 3] px, of the source camera.

        Returns:
            The view, of the frames' size; differentiable.
        """
        sides = self.splat(clouds, camera, motion, K)
        return compose_view(sides, self.paint(sides))

    def _show_all(
        self, clouds: Sequence[Cloud], cameras: Sequence[Camera], motion: Motion, K: torch.Tensor
    ) -> list[RenderedView]:
        """`show` in each camera, and in one that comes twice once."""
        views: list[RenderedView] = []
        for camera in cameras:
            known = known_view(cameras[: len(views)], views, camera) if self.skip.views else None
            self.tally.add("views", known is not None, 1, "views")
            views.append(known or self.show(clouds, camera, motion, K))
        return views

    def splat(self, clouds: Sequence[Cloud], camera: Camera, motion: Motion, K: torch.Tensor) -> list[Side]:
        """What each cloud leaves on the view; arguments as in `show`."""
        height, width = motion.flow0.shape[2:]
        known = camera, K, motion.rigid.detach(), self.config.render, height, width
        if self.config.render.previous == "all" or len(clouds) == 1:
            return [splat_cloud(cloud, *known) for cloud in clouds]
        prev, cur = clouds
        front = splat_cloud(cur, *known)
        uncovered = front.coverage.detach() < OPAQUE
        behind = splat_cloud(prev, *known, uncovered, self.tally if self.skip.covered else None)
        return [Side(*(plane * uncovered for plane in behind)), front]

    def paint(self, sides: Sequence[Side]) -> torch.Tensor:
        """The refined image [B, 3, H, W], from the channels that `RenderConfig.channels` counts."""
        render = self.config.render
        planes = [refined_channels(side, render.colour, render.normalised) for side in sides]
        with self._autocast():
            return self.refine(torch.cat(planes, dim=1)).to(planes[0].dtype)

    def _check(self, frame_prev: LayerBatch, frame_cur: LayerBatch, K: torch.Tensor, prior: MotionPrior | None) -> None:
        check_frames(frame_prev, frame_cur, K)
        if (prior is None) == (self.config.start == "prior"):
            wanted = "a `MotionPrior`" if prior is None else "None"
            raise ValueError(f"`prior` must be {wanted} for {self.config.name}, which starts from {self.config.start}")
        if prior is not None:
            check_prior(prior, frame_cur.image)

    def _encoding(self) -> object:
        """What features depend on beside the frame; None where they are not remembered."""
        known = version(self.encoder) if self.skip.seen else None
        return known and (known, self.skip, self.autocast)

    def _autocast(self) -> torch.autocast:
        return torch.autocast("cpu", self.autocast, enabled=self.autocast is not None)

    # ---------------------------------------------------------------- files

    def save(self, path: Path | str) -> None:
        """Write weights and configuration to a safetensors file, in one step.

        Args:
            path: the file, ``*.safetensors``; its folder is made where it does not exist.

        Raises:
            ValueError: the folder can't be made.
        """
        write_checkpoint(path, self.config, self.state_dict())

    @classmethod
    def load(cls, path: Path | str) -> "Forecaster":
        """The model that `save` wrote, in evaluation mode, on the CPU.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a damaged file, one without a configuration, or weights that don't fit it.
        """
        config, state = read_checkpoint(path)
        model = cls(config)
        try:
            model.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"`path` must hold the weights of {config.name}, got {path} ({error})") from error
        return model.eval()
