"""One frame of a drive: its forecast, its scores, and its image of the video."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from vestcl.data.sample import Clip
from vestcl.evaluation.compare import FORECAST, METRICS
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.scores import Prediction, Record, Timed, Truth, predictions, score
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.views import seen_by
from vestcl.io.contact_sheet import Cell, Picture, heat, rgb, sheet
from vestcl.scene.perception import Perception

ForecastFrame = Callable[[Perception, int, int, Sequence[View]], Forecast]
"""Called with the perception of a clip, the index of t, the steps and the views."""

#: Frames before t whose true images are kept: baselines need them.
_BEFORE: Final = 2

#: Widest image of the video's cells, px: four of them are within what browsers' decoders take.
_CELL_WIDTH: Final = 640

_SOURCE: Final = View("source", np.eye(4))

#: Columns of scores.csv before the metrics.
COLUMNS: Final = ("clip", "frame", "name", "seconds", "view", "method", "step")


class DriveFrames:
    """Forecasts of a clip's frames, in rising order; what they share is computed once, and dropped when it is done.

    Args:
        clip: at its own size, with true frames.
        perception: of the same clip.
        methods: what forecasts; the first is the one that is shown.
        baselines: whether the baselines are scored, too.
        trunk: SqueezeNet 1.0, for the squeeze distance.
        st_lpips: for ST-LPIPS.
        size: (height, width) px that images are scored at; None is the clip's.
    """

    def __init__(
        self,
        clip: Clip,
        perception: Perception,
        methods: Mapping[str, ForecastFrame],
        *,
        baselines: bool = False,
        trunk: Trunk | None = None,
        st_lpips: StLpips | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.clip, self.perception, self.methods, self.baselines = clip, perception, dict(methods), baselines
        self._truth = Truth(clip, size or (clip[0].height, clip[0].width), trunk, st_lpips=st_lpips)

    def forecast(self, index: int, steps: int, views: Sequence[View]) -> tuple[list[Record], Picture]:
        """Forecast from frame ``index``, score it and show it.

        Args:
            index: the frame t, 1 or more, with true frames at ``steps`` intervals after it.
            steps: frames to forecast.
            views: cameras; those from which no image was taken have no scores.

        Returns:
            A record per view with a truth and method, and the image of the last step.

        Raises:
            ValueError: a file missing or damaged, or a clip without a source of depth.
        """
        self._truth.forget(index - _BEFORE)
        forecasts = {name: make(self.perception, index, steps, views) for name, make in self.methods.items()}
        forecast = forecasts[FORECAST]
        known = [view for view in views if seen_by(view, self.clip[index]) is not None]
        later = self.clip.after(index, steps)
        records = self._scored(index, forecasts, known, later)
        rows = [self._row(index, later[-1], forecast, view, records) for view in views]
        return records, sheet(rows, title=self._title(index, forecast, steps), cell_width=_CELL_WIDTH)

    def _scored(
        self, index: int, forecasts: Mapping[str, Forecast], known: Sequence[View], later: Sequence[int]
    ) -> list[Record]:
        if not known:
            return []
        timed = {name: Timed(each, 0.0) for name, each in forecasts.items()}
        made = {
            view.name: {
                name: Prediction([frame[view.name].image for frame in each.frames], 0.0)
                for name, each in forecasts.items()
            }
            for view in known
        }
        if self.baselines:
            made = predictions(self._truth, index, len(later), known, timed)
        records = score(self._truth, index, known, made, forecasts[FORECAST], later=later)
        names = [view.name for view in known]
        return sorted(records, key=lambda record: (names.index(record.view), record.method != FORECAST))

    def _title(self, index: int, forecast: Forecast, steps: int) -> str:
        sample, ahead = self.clip[index], steps * (self.clip.interval or 0.0)
        time = "" if sample.timestamp is None else f", {sample.timestamp - (self.clip[0].timestamp or 0.0):.2f} s"
        horizon = f" ({ahead:.2g} s)" if ahead else ""
        return f"{self.clip.name}, t = frame {sample.name}{time}: {forecast.method} forecast of t+{steps}{horizon}"

    def _row(self, index: int, at: int, forecast: Forecast, view: View, records: Sequence[Record]) -> list[Cell | None]:
        steps, shown = len(forecast.frames), forecast.frames[-1][view.name].image
        camera = seen_by(view, self.clip[index])
        seen = self._truth.full(view if camera is not None else _SOURCE, index)
        whose = view.name if camera is not None else "source"
        cells: list[Cell | None] = [
            Cell(rgb(seen), f"seen: {whose}, t"),
            Cell(rgb(shown), f"forecast: {view.name}, t+{steps}"),
        ]
        if camera is None:
            return [*cells, None, None]
        truth = self._truth.full(view, at)
        (own,) = (each for each in records if (each.view, each.method) == (view.name, FORECAST))
        error = np.abs(shown - truth).mean(axis=0, keepdims=True)
        label = f"error: PSNR {own.scores['psnr'][-1]:.1f} dB"
        return [*cells, Cell(rgb(truth), f"truth: {view.name}, t+{steps}"), Cell(heat(error), label)]


def score_rows(records: Sequence[Record], seconds: float | None) -> list[list[str]]:
    """Lines of scores.csv: `COLUMNS`, then the metrics of `METRICS`; empty where a frame is too small for one.

    Args:
        records: of one frame.
        seconds: its time in the clip, or None.
    """
    time = "" if seconds is None else f"{seconds:.3f}"
    return [
        [
            *(record.clip, str(record.index), record.frame, time, record.view, record.method, str(step + record.first)),
            *(_text(record.scores[metric][step]) if metric in record.scores else "" for metric in METRICS),
        ]
        for record in records
        for step in range(len(record.scores["psnr"]))
    ]


def _text(value: float) -> str:
    return f"{value:.6g}"
