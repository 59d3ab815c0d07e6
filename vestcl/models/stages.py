"""The networks and the stages of a forecast, from left to right as in the paper's figure."""

import functools
import itertools
from collections.abc import Sequence

import torch
from torch import nn

from vestcl import geometry
from vestcl.models.config import OPAQUE, ModelConfig
from vestcl.models.inference.options import EXACT
from vestcl.models.inference.resolution import enlarged, fraction, reduced
from vestcl.models.inference.skipping import current_tally
from vestcl.models.inference.stage_times import timed
from vestcl.models.networks.ego_motion import CameraMotion, EgoMotion, RigidMotion
from vestcl.models.networks.encoder import Encoder
from vestcl.models.networks.layers import side_by_side
from vestcl.models.networks.object_motion import ObjectMotion, ObjectMotionForecast
from vestcl.models.networks.refine import Refine
from vestcl.models.steps.clouds import Cloud, as_image, join, lift, lift_hidden
from vestcl.models.steps.encode import encode
from vestcl.models.steps.frames import EncodedFrame, grid_depth, grid_mean, with_depth
from vestcl.models.steps.memory import EncodedFrames, State
from vestcl.models.steps.motion import Motion, flattened, without_z
from vestcl.models.steps.move_objects import move_objects, unmoved
from vestcl.models.steps.prior import MotionPrior, residual_flow
from vestcl.models.steps.render import (
    Camera,
    RenderedView,
    Side,
    compose_view,
    inner_holes,
    looks_of,
    refined_channels,
    splat_cloud,
)
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject
from vestcl.scene.layers import LayerBatch


class Stages(nn.Module):
    """Encode, move, lift, show: what `Forecaster` puts together.

    Args:
        config: sizes and choices.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config, features = config, config.encoder.features
        self.encoder = Encoder(config.encoder)
        self.ego_motion = None if config.ego_motion is None else EgoMotion(config.ego_motion, features, config.start)
        self.object_motion = None if config.object_motion is None else ObjectMotion(config.object_motion, features)
        self.refine = Refine(config.refine, config.render, features)
        #: What is skipped and what is computed more coarsely; `vestcl.models.inference.skipping.count_skips` counts
        #: the former.
        self.options = EXACT
        #: The frames that were encoded last.
        self.memory = EncodedFrames()

    @property
    def flat(self) -> bool:
        """Whether all motion is a 2D flow: without depth there is no z."""
        return self.config.fixed_depth is not None

    @timed
    def encode(self, frame: LayerBatch) -> EncodedFrame:
        """Features of a frame and of its background, in one pass, and what EMF sees in it; backgrounds without
        foreground in front are the frame itself.

        Args:
            frame: layers of B frames.

        Returns:
            Features [B, C, H, W], and depths replaced where the configuration fixes them.
        """
        layers = with_depth(frame, self.config.fixed_depth)
        tally, state = current_tally(), self._state()
        if state is not None:
            known = self.memory.find(state, frame)
            tally.add("seen", len(frame.image) * (known is not None), len(frame.image), "frames")
            if known is not None:
                return known._replace(layers=layers)
        with self._autocast():
            encoded = encode(self.encoder, self.config.encoder, layers, self.options, tally)
        if self.ego_motion is not None:
            depth, mask = grid_depth(layers.background_depth), grid_mean(layers.mask)
            encoded = encoded._replace(camera_grid=self.ego_motion.look(encoded.background_grid, depth, mask))
        if state is not None:
            self.memory.keep(state, frame, encoded)
        return encoded

    def move(
        self,
        prev: EncodedFrame,
        cur: EncodedFrame,
        K: torch.Tensor,
        prior: MotionPrior | None = None,
        own: torch.Tensor | None = None,
    ) -> Motion:
        """The camera's motion from both frames to the next, the rigid flow that it makes, and the objects' flow.

        Args:
            prev: frame at t - 1.
            cur: frame at t.
            K: [B, 3, 3] px.
            prior: what both start from.
            own: [B, 1, H, W], 1 where the recording car itself is in the image, see `move_camera`.

        Returns:
            `Motion`; differentiable.
        """
        to_next = self.move_camera(prev, cur, prior, own)
        points = unproject(prev.layers.depth, K), unproject(cur.layers.depth, K)
        flows = [rigid_flow(xyz, *rigid) for xyz, rigid in zip(points, to_next[:2], strict=True)]
        flow0 = as_image(torch.cat(flows, dim=2), *cur.features.shape[2:])
        start = flow0 if prior is None or self.object_motion is None else flow0 + residual_flow(prior, to_next[:2])
        if self.flat:
            flow0, start = flattened(points, flow0), flattened(points, start)
        spans = (2.0 if prior is None else prior.span, 1.0)
        if prior is not None and not prior.is_corrected:
            return Motion(*to_next, points, flow0, start, unmoved(start), spans)
        objects = self.move_objects(prev, cur, to_next, flow0, start)
        if self.flat:
            candidates = [without_z(candidate) for candidate in objects.candidates]
            objects = objects._replace(flow=without_z(objects.flow), candidates=candidates)
        return Motion(*to_next, points, flow0, start, objects, spans)

    @timed
    def move_camera(
        self,
        prev: EncodedFrame,
        cur: EncodedFrame,
        prior: MotionPrior | None = None,
        own: torch.Tensor | None = None,
    ) -> CameraMotion:
        """EMF on the encoder's grid: the camera's motion; rest where the model has no EMF, an uncorrected prior's.

        Args:
            prev: frame at t - 1.
            cur: frame at t.
            prior: what EMF starts from.
            own: [B, 1, H, W], 1 where the recording car itself is in either image: it moves with the camera, so
                tokens of it are masked, as foreground is; None is nowhere.
        """
        if prior is not None and not prior.is_corrected:
            known = prior.camera
            later = tuple(known.interval(k) for k in range(1, known.intervals))
            return CameraMotion(prior.next_from_cur.after(prior.cur_from_prev), prior.next_from_cur, later)
        if self.ego_motion is None or prev.camera_grid is None or cur.camera_grid is None:
            return CameraMotion(*2 * (RigidMotion.rest(cur.features),))
        masks = [frame.layers.mask if own is None else frame.layers.mask * (1 - own) for frame in (prev, cur)]
        mask_prev, mask_cur = map(grid_mean, masks)
        start = None if prior is None else prior.camera
        return self.ego_motion.decide(prev.camera_grid, cur.camera_grid, mask_prev, mask_cur, start)

    @timed
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
        return move_objects(self.object_motion, prev, cur, to_next, flow0, start, self.options, current_tally())

    @timed
    def lift(self, prev: EncodedFrame, cur: EncodedFrame, motion: Motion, K: torch.Tensor) -> list[Cloud]:
        """Both frames' layers as clouds on their way to t + 1; with `RenderConfig.joint` as one.

        Inpainted points follow the camera's motion. Without EMF there is none: they move by object motion at their
        pixel.

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
        of_prev, of_cur = itertools.starmap(
            lift, zip((prev, cur), motion.points, flows, flows0, motion.spans, strict=True)
        )
        by_objects = self.ego_motion is None and motion.objects.ran.shape[1] > 0
        behind_prev, behind_cur = (
            functools.partial(lift_hidden, frame, to_next, K, flow if by_objects else None, span, self.flat)
            for frame, to_next, flow, span in zip((prev, cur), rigid, flows, motion.spans, strict=True)
        )
        if render.inpainted != "own":
            clouds = [join(of_prev, behind_cur()), of_cur]
        else:
            clouds = [join(of_prev, behind_prev()), join(of_cur, behind_cur())]
        return [join(*clouds)] if render.joint else clouds

    def show(self, clouds: Sequence[Cloud], camera: Camera, motion: Motion, K: torch.Tensor) -> RenderedView:
        """Splat each cloud into a camera, and compute the image.

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

    @timed
    def splat(self, clouds: Sequence[Cloud], camera: Camera, motion: Motion, K: torch.Tensor) -> list[Side]:
        """What each cloud leaves on the view, of the frames' size; arguments as in `show`."""
        height, width = motion.flow0.shape[2:]
        size = fraction(height, width, self.options.splat_scale)
        if size != (height, width):
            camera = camera._replace(K=geometry.scale_intrinsics(camera.K, size[1] / width, size[0] / height))
        sides = self._splat(clouds, camera, motion, K, size)
        return [Side(*(enlarged(plane, height, width) for plane in side)) for side in sides]

    @timed
    def paint(self, sides: Sequence[Side]) -> torch.Tensor:
        """The refined image [B, 3, H, W], from the channels that `RenderConfig.channels` counts.

        What refinement adds to its base is computed at `InferenceOptions.paint_scale`, from means over the sides'
        cells. A refinement of geometric forecasts leaves the base as it is.
        """
        render = self.config.render
        if self.refine.of_forecast:
            return self.refine.base_of([looks_of(side, render.normalised) for side in sides])
        height, width = sides[0].coverage.shape[2:]
        size = fraction(height, width, self.options.paint_scale)
        if size != (height, width) and self.refine.base == "none":
            raise ValueError(
                f"`options.paint_scale` must be 1 for {self.config.name}, which predicts RGB directly, got {size}"
            )
        seen = [Side(*(reduced(plane, *size) for plane in side)) for side in sides]
        rendered = side_by_side([refined_channels(side, render.colour, render.normalised) for side in seen])
        with self._autocast():
            if size == (height, width):
                return self.refine(rendered).to(rendered.dtype)
            added = self.refine.painted(rendered).to(rendered.dtype)
        base = self.refine.base_of([looks_of(side, render.normalised) for side in sides])
        image = base + enlarged(added, height, width)
        return image if self.training else image.clamp(0, 1)

    @timed
    def retouch(self, planes: torch.Tensor) -> torch.Tensor:
        """What refinement adds to the image of a geometric forecast, [B, 3, H, W].

        As `paint`, at `InferenceOptions.paint_scale`.

        Args:
            planes: [B, FORECAST_PLANES, H, W], of `vestcl.forecasting.network.planes`.
        """
        height, width = planes.shape[2:]
        with self._autocast():
            painted = self.refine.painted(reduced(planes, *fraction(height, width, self.options.paint_scale)))
        return self.refine.change(planes, enlarged(painted.to(planes.dtype), height, width))

    def _splat(
        self, clouds: Sequence[Cloud], camera: Camera, motion: Motion, K: torch.Tensor, size: tuple[int, int]
    ) -> list[Side]:
        known = camera, K, motion.rigid.detach(), self.config.render, *size, self.options.min_transmittance
        if self.config.render.previous == "all" or len(clouds) == 1:
            return [splat_cloud(cloud, *known, flat=self.flat) for cloud in clouds]
        prev, cur = clouds
        front = splat_cloud(cur, *known, flat=self.flat)
        uncovered = front.coverage.detach() < OPAQUE
        deep = inner_holes(uncovered) if self.config.render.inpainted == "inner" else None
        tally = current_tally() if self.options.covered else None
        behind = splat_cloud(prev, *known, uncovered, tally, deep, self.flat)
        return [Side(*(plane * uncovered for plane in behind)), front]

    def _state(self) -> State | None:
        """What features depend on besides the frame; None where they are not remembered."""
        if torch.is_grad_enabled() or not self.options.seen:
            return None
        networks = [network for network in (self.encoder, self.ego_motion) if network is not None]
        weights = [weight for network in networks for weight in (*network.parameters(), *network.buffers())]
        around = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else None
        return self.memory.state((self.config, self.options.of_encoder, around), weights)

    def _autocast(self) -> torch.autocast:
        name = self.options.autocast
        return torch.autocast("cpu", None if name is None else getattr(torch, name), enabled=name is not None)
