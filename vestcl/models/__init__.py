"""The networks: encoder, ego-motion (EMF), object motion (OMF), refinement; and their configurations."""

from vestcl.models.config import CONFIGS, VARIANTS, ModelConfig, configuration
from vestcl.models.networks.ego_motion import EgoMotion, RigidMotion
from vestcl.models.networks.encoder import Encoder, load_resnet34, upsample_features
from vestcl.models.networks.object_motion import ObjectMotion, ObjectMotionForecast, budget_loss
from vestcl.models.networks.refine import Refine

__all__ = [
    "CONFIGS",
    "VARIANTS",
    "EgoMotion",
    "Encoder",
    "ModelConfig",
    "ObjectMotion",
    "ObjectMotionForecast",
    "Refine",
    "RigidMotion",
    "budget_loss",
    "configuration",
    "load_resnet34",
    "upsample_features",
]
