"""The whole network: two frames in, future frames out, from any camera."""

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Final, get_args

import torch
from huggingface_hub import ModelHubMixin, hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError

from vestcl.models.checkpoint import read_checkpoint, write_checkpoint
from vestcl.models.config import Mode
from vestcl.models.inference.skipping import current_tally
from vestcl.models.shipped import find_model
from vestcl.models.stages import Stages
from vestcl.models.steps.clouds import Cloud, advance
from vestcl.models.steps.frames import check_frames
from vestcl.models.steps.motion import Motion, Step, arrived, next_prior
from vestcl.models.steps.perceive import Perceive, known_view, perceive_estimated, perceive_forecast, perceive_view
from vestcl.models.steps.prior import MotionPrior, check_prior
from vestcl.models.steps.render import Camera, RenderedView, checked_camera
from vestcl.models.weights_file import misfit
from vestcl.scene.layers import LayerBatch
from vestcl.shapes import check

__all__ = [
    "Camera",
    "Forecaster",
    "Mode",
    "Motion",
    "Perceive",
    "RenderedView",
    "Step",
    "perceive_estimated",
    "perceive_forecast",
]

Views = Sequence[tuple[torch.Tensor, torch.Tensor]]

#: A model's file in a folder that `Forecaster.save_pretrained` writes.
WEIGHTS: Final = "model.safetensors"

#: A repository on a hub: OWNER/NAME.
_REPOSITORY: Final = re.compile(r"[\w.-]+/[\w.-]+")

_CARD: Final = """---
# Metadata: https://huggingface.co/docs/hub/model-cards
{{ card_data }}
---

# A vestcl network

It forecasts future frames of a driving video and shows them from any camera (video extrapolation in space and time).
`model.safetensors` holds weights and configuration; `config.json` repeats the configuration.

```python
import vestcl

model = vestcl.Forecaster.from_pretrained("THIS FOLDER OR REPOSITORY")
future = vestcl.forecast(vestcl.open("drive.mp4", fov=60), model=model)
```

The licence above is the licence of the file of weights. Trained as in Yarram and Yuan, "Forecasting Future Videos from
Novel Views via Disentangled 3D Scene Representation", ECCV 2024.
"""


class Forecaster(
    Stages,
    ModelHubMixin,
    library_name="vestcl",
    license="apache-2.0",
    pipeline_tag="image-to-image",
    tags=["video-prediction", "novel-view-synthesis", "driving"],
    model_card_template=_CARD,
):
    """Encode, lift, forecast the camera's and then the objects' motion, displace, splat, refine.

    Both input frames become a cloud each: every pixel, and where foreground hides the background that is inpainted
    behind it. Inpainted points move with the static world, all others by object motion; without EMF
    all do. Both clouds go to t + 1 directly, and are splatted there into every camera that is asked for.

    Args:
        config: sizes and choices; `vestcl.models.configuration` knows some by name.

    Source: SPEC sections 3 to 6; the paper's overview figure.
    """

    def forward(
        self,
        frame_prev: LayerBatch,
        frame_cur: LayerBatch,
        K: torch.Tensor,
        views: Views | None = None,
        *,
        prior: MotionPrior | None = None,
        own: torch.Tensor | None = None,
        horizon: int = 1,
    ) -> Step:
        """Frame t + ``horizon``, motion composed, with everything that a loss needs; arguments as of `forecast`."""
        last = {"mode": "compose", "shown": (horizon,), "prior": prior, "own": own}
        return self.forecast(frame_prev, frame_cur, K, horizon, views, **last)[-1]  # type: ignore[arg-type]

    def forecast(
        self,
        frame_prev: LayerBatch,
        frame_cur: LayerBatch,
        K: torch.Tensor,
        steps: int = 1,
        views: Views | None = None,
        mode: Mode | None = None,
        perceive: Perceive | None = None,
        *,
        prior: MotionPrior | None = None,
        own: torch.Tensor | None = None,
        shown: Collection[int] | None = None,
    ) -> list[Step]:
        """Forecast t + 1 to t + steps.

        Args:
            frame_prev: B frames at t - 1; depths above 0, all of one size.
            frame_cur: the same at t.
            K: [B, 3, 3] px, of both.
            steps: number of future frames.
            views: the cameras to show, as (tgt_from_next [B, 4, 4], K [B, 3, 3]), each at its own future time; None
                is the source camera only; none at all forecasts motion, with "compose" only.
            mode: "feedback" feeds each forecast frame, seen from the source camera, back as input of the next step,
                without gradients between steps. "compose" does not encode again: the camera continues as
                forecast at t, and repeats its last motion beyond that; objects repeat their motion in the world. None
                is `ModelConfig.default_mode`.
            perceive: for "feedback", (image [B, 3, H, W], depth [B, 1, H, W] m with 0 = unknown, mask [B, 1, H, W])
                -> layers of that forecast frame; None is `perceive_forecast`.
            prior: motion that was measured, only for models that start from it; with "feedback" later steps
                continue with the motion that the first one forecast, which is not corrected again.
            own: [B, 1, H, W], 1 where the recording car itself is in the images, which EMF's attention and mean leave
                out; it stays there in later frames. None is nowhere.
            shown: steps k to show, of 1 ... steps; None shows all.

        Returns:
            One `Step` per future frame; differentiable in parameters and images.

        Raises:
            ValueError: an argument of another shape, a depth that is not above 0, less than one step, another mode,
                or a prior that is missing or not expected.
        """
        self._check(frame_prev, frame_cur, K, prior, own)
        mode = mode or self.config.default_mode
        if steps < 1 or mode not in get_args(Mode):
            raise ValueError(f'`steps` must be >= 1 and `mode` "feedback" or "compose", got {steps} and {mode!r}')
        straight = Camera(torch.eye(4).to(K).expand(len(K), 4, 4), K)
        cameras = [straight] if views is None else [checked_camera(camera, len(K)) for camera in views]
        prev, cur = self.encode(frame_prev), self.encode(frame_cur)
        motion = self.move(prev, cur, K, prior, own)
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
                clouds = [advance(cloud, motion.rigid, self.flat) for cloud in clouds]
            else:
                looked = known_view(cameras, seen, straight) if seen else None
                view = looked or self.show(clouds, straight, motion, K)
                prior = None if prior is None else next_prior(prior, motion, view, K)
                prev, cur = cur, self.encode(perceive_view(view, perceive or perceive_forecast))
                motion = self.move(prev, cur, K, prior, own)
                clouds = self.lift(prev, cur, motion, K)
            future_from_cur = motion.rigid @ future_from_cur

    def present(
        self,
        frame_prev: LayerBatch,
        frame_cur: LayerBatch,
        K: torch.Tensor,
        views: Views,
        prior: MotionPrior | None,
        own: torch.Tensor | None = None,
    ) -> list[RenderedView]:
        """Frame t itself from other cameras: what t shows stays where it is, and what t - 1 shows comes to t.

        cur_from_prev is the prior's, or else the network's, next_from_cur^-1 next_from_prev.

        Args:
            frame_prev: B frames at t - 1.
            frame_cur: the same at t.
            K: [B, 3, 3] px, of both.
            views: the cameras to show, as (tgt_from_cur [B, 4, 4], K [B, 3, 3]).
            prior: as of `forecast`.
            own: as of `forecast`.

        Returns:
            A view per camera; differentiable.

        Raises:
            ValueError: as `forecast`.
        """
        self._check(frame_prev, frame_cur, K, prior, own)
        cameras = [checked_camera(camera, len(K)) for camera in views]
        prev, cur = self.encode(frame_prev), self.encode(frame_cur)
        to_next = self.move_camera(prev, cur, None, own) if prior is None else prior
        motion = arrived(prev, cur, K, to_next, self.flat)
        clouds = self.lift(prev, cur, motion, K)
        return self._show_all(clouds, cameras, motion, K)

    def _show_all(
        self, clouds: Sequence[Cloud], cameras: Sequence[Camera], motion: Motion, K: torch.Tensor
    ) -> list[RenderedView]:
        """`show` in each camera, a repeated one only once."""
        views: list[RenderedView] = []
        for camera in cameras:
            known = known_view(cameras[: len(views)], views, camera) if self.options.views else None
            current_tally().add("views", known is not None, 1, "views")
            views.append(known or self.show(clouds, camera, motion, K))
        return views

    def _check(
        self,
        frame_prev: LayerBatch,
        frame_cur: LayerBatch,
        K: torch.Tensor,
        prior: MotionPrior | None,
        own: torch.Tensor | None,
    ) -> None:
        check_frames(frame_prev, frame_cur, K)
        if own is not None:
            batch, _, height, width = frame_cur.image.shape
            check(own=(own, f"{batch} 1 {height} {width}"))
        if (prior is None) == (self.config.start == "prior"):
            wanted = "a `MotionPrior`" if prior is None else "None"
            raise ValueError(f"`prior` must be {wanted} for {self.config.name}, which starts from {self.config.start}")
        if prior is not None:
            check_prior(prior, frame_cur.image)

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
    def from_pretrained(cls, name: Path | str, **options: Any) -> "Forecaster":  # type: ignore[override]
        """A trained network, in evaluation mode, on the CPU, in float32, regardless of the file's precision.

        Args:
            name: "vest-s", which ships with vestcl; a .safetensors file; a folder that `save_pretrained` or training
                wrote; or a repository on a hub, "OWNER/NAME".
            **options: of `huggingface_hub.hf_hub_download`, for repositories: ``revision``, ``token`` ...

        Raises:
            ValueError: no such name, file, folder or repository; a damaged file, or weights that don't fit their
                configuration.
        """
        if isinstance(name, str) and _REPOSITORY.fullmatch(name) and not Path(name).exists():
            try:
                return cls.load(hf_hub_download(name, WEIGHTS, **options))
            except (HfHubHTTPError, EntryNotFoundError, OSError) as error:
                reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
                raise ValueError(f"{name}: is not a file here, and not available on the hub: {reason}") from error
        return cls.load(find_model(name))

    def _save_pretrained(self, save_directory: Path) -> None:
        self.save(save_directory / WEIGHTS)

    @classmethod
    def load(cls, path: Path | str) -> "Forecaster":
        """The model that `save` wrote, in evaluation mode, on the CPU.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a damaged file, one without a configuration, or weights that don't fit it or are not finite.
        """
        config, state = read_checkpoint(path)
        model = cls(config)
        if reason := misfit(state, model.state_dict()):
            raise ValueError(f"`path` must hold the weights of {config.name}, got {path}, which {reason}")
        model.load_state_dict(state)
        return model.eval()
