"""What `vestcl view` does: open a clip, serve the viewer's page, and end with Ctrl-C or the page's button."""

import sys
import warnings

from vestcl import interrupt, opencl
from vestcl.cli import checks, commands
from vestcl.cli.clip import open_clip
from vestcl.scene.inpainting.inpainters import inpainter


def run(options: commands.View) -> None:
    """Do what the options ask for.

    Raises:
        ValueError: viser is not installed, an option out of range, or a file that is missing or malformed.
        DeviceError: no such OpenCL device.
    """
    from vestcl.viewer.server import Viewer, import_viser

    import_viser()
    checks.check_file_options(options)
    if options.quality is not None and options.model is None:
        raise ValueError("`quality` is the inference preset of a network; it needs `model`")
    clip = open_clip(options.input, options, (options.height, options.width), options.frames)
    inpaint = None if options.inpaint is None else inpainter(options.inpaint, "inpaint")
    preset, index, port = options.quality or "balanced", options.frame, options.port
    with (
        warnings.catch_warnings(),
        opencl.use(options.device),
        interrupt.summary(lambda: "the viewer is closed"),
        Viewer(clip, options.model, preset, index=index, port=port, inpaint=inpaint) as viewer,
    ):
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # of a page that was closed
        print(f"{viewer.url} shows {clip.name}; Ctrl-C closes it")
        sys.stdout.flush()
        viewer.wait()
