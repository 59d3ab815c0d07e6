"""Images, and checkpoints as the hub has them: of tiny networks with random weights, which answer in milliseconds."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

STAGES = ["stage1", "stage2", "stage3", "stage4"]
ROOM = {"name": "nyu", "n_bins": 8, "min_depth": 1e-3, "max_depth": 10.0}
STREET = {"name": "kitti", "n_bins": 8, "min_depth": 1e-3, "max_depth": 80.0}

#: ImageNet's, and those of the processors that are published with DPT's and BEiT's networks.
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
HALVES = {"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}


#: Weights of Mask2Former's two answers against all others', so that queries differ in class and in place.
QUERY_GAIN = 4.0


def noise_image(height: int = 48, width: int = 120, seed: int = 0) -> NDArray[np.float32]:
    """Smooth colours, in steps of 1/255 as any file's."""
    coarse = np.random.default_rng(seed).random((1, 3, 5, 9), np.float32)
    smooth = torch.nn.functional.interpolate(torch.from_numpy(coarse), (height, width), mode="bicubic").clamp(0, 1)
    return (smooth[0] * 255).round().numpy().astype(np.float32) / np.float32(255)


def pixels(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The same in whole steps."""
    return (image * 255).round().astype(np.uint8)


def transformers() -> Any:
    """The module; the test is skipped where it is not installed."""
    return pytest.importorskip("transformers", reason="transformers is not installed: pip install 'vestcl[estimators]'")


def processor(name: str, **settings: Any) -> Any:
    """transformers' own, of the kind that needs no torchvision; its name differs between versions 4 and 5."""
    module = transformers()
    return getattr(module, f"{name}Pil", None) or getattr(module, name)


def save(model: Any, name: str, folder: Path, **settings: Any) -> Path:
    """With weights of deviation 1 / sqrt(inputs): the answer depends on the image, but not on its last bits."""
    generator = torch.Generator().manual_seed(0)
    for key, parameter in model.named_parameters():
        if parameter.ndim > 1:
            gain = QUERY_GAIN if "class_predictor" in key or "mask_embedder" in key else 1
            torch.nn.init.normal_(parameter, std=gain / np.sqrt(parameter[0].numel()), generator=generator)
        elif key.endswith("bias"):
            torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    model.save_pretrained(folder)
    processor(name)(**settings).save_pretrained(folder)
    return folder


def zoedepth(folder: Path, heads: list[dict[str, Any]], vote: int | None = None) -> Path:
    """ZoeDepth; with ``vote``, one whose classifier votes for that head whatever it sees."""
    t = transformers()
    backbone = t.BeitConfig(
        image_size=64, patch_size=16, hidden_size=16, num_hidden_layers=4, num_attention_heads=2, intermediate_size=16,
        out_features=STAGES, reshape_hidden_states=False, use_relative_position_bias=True,
    )  # fmt: skip
    several = {
        "num_patch_transformer_layers": 4, "patch_transformer_hidden_size": 128,
        "patch_transformer_intermediate_size": 16, "patch_transformer_num_attention_heads": 2,
    }  # fmt: skip
    config = t.ZoeDepthConfig(
        backbone_config=backbone, neck_hidden_sizes=[8] * 4, fusion_hidden_size=8, bottleneck_features=8,
        num_relative_features=8, bin_embedding_dim=8, bin_configurations=heads, **(several if len(heads) > 1 else {}),
    )  # fmt: skip
    model = t.ZoeDepthForDepthEstimation(config)
    save(model, "ZoeDepthImageProcessor", folder, size={"height": 64, "width": 96}, ensure_multiple_of=32)
    if vote is not None:
        last = [layer for layer in model.metric_head.mlp_classifier.modules() if hasattr(layer, "bias")][-1]
        torch.nn.init.zeros_(last.weight)
        last.bias.data = torch.eye(2)[vote]
        model.save_pretrained(folder)
    return folder


def depth_anything(folder: Path, kind: str = "metric", farthest: int = 80) -> Path:
    """Depth Anything with a DINOv2 of four layers."""
    t = transformers()
    backbone = t.Dinov2Config(
        image_size=56, patch_size=14, hidden_size=16, num_hidden_layers=4, num_attention_heads=2, mlp_ratio=1,
        out_features=STAGES, reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = t.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8] * 4, fusion_hidden_size=8,
        head_hidden_size=8, depth_estimation_type=kind, max_depth=farthest,
    )  # fmt: skip
    settings = {"size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3}
    return save(t.DepthAnythingForDepthEstimation(config), "DPTImageProcessor", folder, **settings, **IMAGENET)


def segformer(folder: Path, classes: tuple[str, ...]) -> Path:
    """SegFormer with the smallest of encoders."""
    t = transformers()
    config = t.SegformerConfig(
        depths=[1] * 4, hidden_sizes=[8, 8, 8, 8], num_attention_heads=[1, 1, 1, 1], decoder_hidden_size=8,
        id2label=dict(enumerate(classes)), label2id={label: i for i, label in enumerate(classes)},
    )  # fmt: skip
    size = {"height": 64, "width": 64}
    return save(t.SegformerForSemanticSegmentation(config), "SegformerImageProcessor", folder, size=size)


def mask2former(folder: Path, classes: tuple[str, ...]) -> Path:
    """Mask2Former with a Swin of four blocks and seven queries."""
    t = transformers()
    backbone = t.SwinConfig(
        image_size=64, patch_size=4, embed_dim=8, depths=[1] * 4, num_heads=[1] * 4, window_size=4, out_features=STAGES
    )
    config = t.Mask2FormerConfig(
        backbone_config=backbone, feature_size=32, mask_feature_size=32, hidden_dim=32, encoder_feedforward_dim=16,
        encoder_layers=1, decoder_layers=2, num_attention_heads=2, dim_feedforward=16, num_queries=7,
        id2label=dict(enumerate(classes)), label2id={label: i for i, label in enumerate(classes)},
    )  # fmt: skip
    size = {"height": 384, "width": 384}  # as published, and what transformers' post-processing expects
    return save(t.Mask2FormerForUniversalSegmentation(config), "Mask2FormerImageProcessor", folder, size=size)
