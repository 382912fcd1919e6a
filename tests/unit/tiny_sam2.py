"""A random checkpoint of 0.5 MB in the layout and architecture of SAM 2."""

from __future__ import annotations

from pathlib import Path

import torch

SIDE = 64


def make(folder: Path, video: bool = False, seed: int = 0) -> Path:
    """Write a checkpoint as small as the architecture allows; `video`: as the published ones, with what videos need.

    Weights are larger than those that training starts from, so that masks have shapes.
    """
    from transformers import Sam2Config, Sam2Model, Sam2VideoConfig, Sam2VideoModel
    from transformers.models.sam2.configuration_sam2 import (
        Sam2HieraDetConfig,
        Sam2MaskDecoderConfig,
        Sam2PromptEncoderConfig,
        Sam2VisionConfig,
    )

    backbone = Sam2HieraDetConfig(
        hidden_size=8, image_size=[SIDE, SIDE], blocks_per_stage=[1, 1, 2, 1], embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8], window_size_per_stage=[8, 4, 4, 4], global_attention_blocks=[3],
        window_positional_embedding_background_size=[2, 2],
    )  # fmt: skip
    parts = {
        "vision_config": Sam2VisionConfig(
            backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], fpn_hidden_size=32,
            backbone_feature_sizes=[[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2],
        ),
        "prompt_encoder_config": Sam2PromptEncoderConfig(hidden_size=32, image_size=SIDE, mask_input_channels=8),
        "mask_decoder_config": Sam2MaskDecoderConfig(
            hidden_size=32, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=16
        ),
    }  # fmt: skip
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = Sam2VideoModel(Sam2VideoConfig(**parts)) if video else Sam2Model(Sam2Config(**parts))
        for name, weight in model.named_parameters():
            if weight.ndim > 1 and "norm" not in name:
                torch.nn.init.normal_(weight, std=1.4 / weight[0].numel() ** 0.5)
    model.save_pretrained(folder)
    return folder
