"""Progress bars on the terminal."""

from rich.progress import Progress


class ProgressBar(Progress):
    """rich's bar; a disabled one prints nothing, not even the empty line that rich before 14.3 ends it with."""

    def stop(self) -> None:
        """End the bar, if it was ever shown."""
        if not self.disable:
            super().stop()
