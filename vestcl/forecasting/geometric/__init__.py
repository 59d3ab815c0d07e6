"""The forecast without trained weights: 3D from depth and motion, all at constant velocity, through the splatter."""

from vestcl.forecasting.geometric.forecast import forecast_clip, forecast_frames, show_frame
from vestcl.scene.perceived import PerceivedFrame
from vestcl.scene.perception import Perception

__all__ = ["PerceivedFrame", "Perception", "forecast_clip", "forecast_frames", "show_frame"]
