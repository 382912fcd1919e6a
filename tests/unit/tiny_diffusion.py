"""Random checkpoints of 1 MB in the layout and architecture of RGB-X and Marigold-IID (0.3 s to make)."""

from __future__ import annotations

import json
from pathlib import Path

import torch

PIPELINE = {"rgbx": "StableDiffusionAOVMatEstPipeline", "marigold": "MarigoldIntrinsicsPipeline"}
TARGETS = {
    "target_names": ["albedo", "material"],
    "albedo": {"prediction_space": "srgb", "up_to_scale": False},
    "material": {"prediction_space": "stack", "sub_target_names": ["roughness", "metallicity", None]},
    "roughness": {"prediction_space": "linear", "up_to_scale": False},
    "metallicity": {"prediction_space": "linear", "up_to_scale": False},
}
LIBRARY = {"text_encoder": "transformers"}


def make(folder: Path, kind: str, seed: int = 0) -> Path:
    """Write a checkpoint of `kind` ("rgbx" or "marigold"), as small as the architecture allows.

    Few groups: the U-Net's last level of a small picture has one pixel, and a group norm over two numbers is a step function.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        targets = 1 if kind == "rgbx" else 2
        size = write_tokenizer(folder / "tokenizer")
        parts = {}
        text = CLIPTextConfig(
            vocab_size=size, hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2,
            max_position_embeddings=77, bos_token_id=size - 2, eos_token_id=size - 1, pad_token_id=0,
        )  # fmt: skip
        parts["text_encoder"] = CLIPTextModel(text)
        cross = "CrossAttnDownBlock2D", "CrossAttnUpBlock2D"
        parts["unet"] = UNet2DConditionModel(
            sample_size=16, in_channels=4 + 4 * targets, out_channels=4 * targets, layers_per_block=1,
            block_out_channels=(16, 16, 16, 16), norm_num_groups=2, attention_head_dim=[2, 2, 2, 2], cross_attention_dim=16,
            use_linear_projection=True, down_block_types=(*cross[:1] * 3, "DownBlock2D"),
            up_block_types=("UpBlock2D", *cross[1:] * 3),
        )  # fmt: skip
        parts["vae"] = AutoencoderKL(
            latent_channels=4, block_out_channels=(8, 8, 8, 8), layers_per_block=1, norm_num_groups=4, sample_size=64,
            down_block_types=("DownEncoderBlock2D",) * 4, up_block_types=("UpDecoderBlock2D",) * 4,
        )  # fmt: skip
        newer = {} if kind == "rgbx" else {"rescale_betas_zero_snr": True, "timestep_spacing": "trailing"}
        parts["scheduler"] = DDIMScheduler(
            beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False, set_alpha_to_one=False,
            steps_offset=1, prediction_type="v_prediction", **newer,
        )  # fmt: skip
    for name, part in parts.items():
        part.save_pretrained(folder / name)
    index = {name: [LIBRARY.get(name, "diffusers"), type(part).__name__] for name, part in parts.items()}
    index |= {"_class_name": PIPELINE[kind], "_diffusers_version": "0.20.0", "tokenizer": ["transformers", "CLIPTokenizer"]}
    if kind == "marigold":
        index |= {"prediction_type": "intrinsics", "target_properties": TARGETS}
        index |= {"default_denoising_steps": 3, "default_processing_resolution": 64}
    (folder / "model_index.json").write_text(json.dumps(index))
    return folder


def write_tokenizer(folder: Path) -> int:
    """CLIP's tokenizer over single bytes, in the files of Stable Diffusion 2: no merges; how many tokens."""
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    letters = [chr(byte) for byte in printable] + [chr(256 + i) for i in range(256 - len(printable))]
    words = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    special = {"bos_token": words[-2], "eos_token": words[-1], "unk_token": words[-1], "pad_token": "!"}
    facts = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 77, "do_lower_case": True, "errors": "replace"}
    folder.mkdir(parents=True)
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    (folder / "special_tokens_map.json").write_text(json.dumps(special))
    (folder / "tokenizer_config.json").write_text(json.dumps(facts | special))
    return len(words)
