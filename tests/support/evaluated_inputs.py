"""What an evaluation reports of its clips."""

from train.evaluation.inputs import Depth, given, label, sentences
from vestcl.data.sample import Clip
from vestcl.scene.inputs import inputs_of


def known_of(clip: Clip, sources: tuple[Depth, ...] = ("clip",)) -> str:
    """The first sentence on one clip, with depth from ``sources``."""
    return sentences({clip.name: {label(depth): inputs_of(given(clip, depth)) for depth in sources}})[0]
