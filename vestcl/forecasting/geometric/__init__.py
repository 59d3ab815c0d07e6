"""The forecast without trained weights: 3D from depth and motion, all at constant velocity, through the splatter."""

from vestcl.forecasting.geometric.forecast import forecast_clip, forecast_frames, show_frame
from vestcl.scene.perception import Perception, Seen

__all__ = ["Perception", "Seen", "forecast_clip", "forecast_frames", "show_frame"]
