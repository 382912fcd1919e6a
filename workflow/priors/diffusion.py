"""Sampling from a latent diffusion model that is conditioned on a photograph, for the priors rgbx and marigold (Eq. P.20, P.21).

Beyond one tile, the U-Net processes overlapping tiles, and its outputs are blended at every step.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

from iif_core.errors import InputError
from iif_core.priors.options import SamplingOptions
from workflow.models.checkpoint import PACKAGES, Checkpoint, Recipe, check
from workflow.models.loading import deterministic, load_network, named_device, quiet
from workflow.settings.options import options_of

PRECISIONS = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
OVERLAP = 0.25  # share of a tile that the next one repeats, as AutoencoderKL has it for its own tiles


# --------------------------------------------------------------------------------------------------------------- pictures


def working_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Return (width, height) of a picture whose longer side becomes `longest`, with its aspect kept to half a pixel."""
    factor = longest / max(width, height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def resize(maps: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize (n, H, W, c) bilinearly to (n, height, width, c), low-pass filtered where it shrinks; NaN spreads to neighbours."""
    if maps.shape[1:3] == (height, width):
        return maps
    planes = torch.from_numpy(np.ascontiguousarray(maps.transpose(0, 3, 1, 2)))
    out = interpolate(planes, (height, width), mode="bilinear", align_corners=False, antialias=True)
    return out.numpy().transpose(0, 2, 3, 1)


def pad(image: np.ndarray, multiple: int) -> np.ndarray:
    """Pad (H, W, 3) at bottom and right by reflection to sides that are multiples of `multiple`."""
    extra = [(0, -size % multiple) for size in image.shape[:2]]
    return np.pad(image, (*extra, (0, 0)), mode="symmetric")


def tile_starts(length: int, tile: int) -> list[int]:
    """Return the first elements of the fewest equally spread tiles that cover `length` and overlap by at least OVERLAP."""
    if length <= tile:
        return [0]
    count = 1 + math.ceil((length - tile) / (tile - int(tile * OVERLAP)))
    return [round(i * (length - tile) / (count - 1)) for i in range(count)]


def tile_weight(height: int, width: int, tile: int) -> torch.Tensor:
    """Return the positive weight (height, width) of a tile's output: 1 inside, falling to its borders over OVERLAP of a tile."""

    def ramp(size: int) -> torch.Tensor:
        i = torch.arange(size, dtype=torch.float32)
        return (torch.minimum(i + 0.5, size - i - 0.5) / max(1.0, tile * OVERLAP)).clamp(max=1.0)

    return ramp(height)[:, None] * ramp(width)


def blend_tiles(apply: Callable[[slice, slice], torch.Tensor], height: int, width: int, tile: int) -> torch.Tensor:
    """Apply a function to overlapping tiles and blend its outputs.

    Args:
        apply: (rows, columns) -> (..., h, w) output of a tile.
        height, width: of the whole.
        tile: largest side of a tile.

    Returns:
        (..., height, width), the weighted mean where tiles overlap.
    """
    rows, columns = tile_starts(height, tile), tile_starts(width, tile)
    if len(rows) == len(columns) == 1:
        return apply(slice(0, height), slice(0, width))
    total = weights = None
    for y in rows:
        for x in columns:
            place = slice(y, min(y + tile, height)), slice(x, min(x + tile, width))
            answer = apply(*place)
            weight = tile_weight(answer.shape[-2], answer.shape[-1], tile).to(answer.device, answer.dtype)
            if total is None:
                total = answer.new_zeros((*answer.shape[:-2], height, width))
                weights = answer.new_zeros((height, width))
            total[(..., *place)] += answer * weight
            weights[place] += weight
    return total / weights


# ------------------------------------------------------------------------------------------------------------------ model


class Model:
    """A loaded checkpoint.

    The U-Net computes in the chosen precision; the VAE and the scheduler always in float32, because a decoder exceeds the range
    of half precision (docs/method/numerics.md#half-precision-overflow).

    Attributes:
        multiple: pixels of which both sides of a picture must be a multiple.
    """

    def __init__(self, recipe: Recipe, prior: SimpleNamespace):
        """Load the model of the settings section `prior`, whose checkpoint is checked again."""
        self.recipe, self.checkpoint = recipe, check(vars(prior), recipe)
        options = options_of(SamplingOptions, prior)
        self.device = named_device(prior.device, recipe)
        self.dtype = _precision(options.precision, self.device)
        self.workers = 1 if self.device.type == "cuda" else torch.get_num_threads()
        self.batch = prior.batch or (1 if self.device.type == "cpu" else 4)
        with quiet("diffusers", "transformers"):
            import diffusers

            self.unet = load_network(self.checkpoint, "unet", diffusers.UNet2DConditionModel).to(self.device, self.dtype)
            self.vae = load_network(self.checkpoint, "vae", diffusers.AutoencoderKL).to(self.device)
            stored = diffusers.DDIMScheduler.load_config(self.checkpoint.folder / "scheduler")
            self.scheduler = diffusers.DDIMScheduler.from_config(stored, **dict(recipe.scheduler))
            self.text = [text.to(self.device, self.dtype) for text in _embeddings(self.checkpoint, recipe)]
        self.reduction = 2 ** (len(self.vae.config.block_out_channels) - 1)
        self.multiple = self.reduction * 2 ** (len(self.unet.config.block_out_channels) - 1)
        self.tile = max(options.tile // self.multiple, 1) * self.multiple
        self.vae.enable_slicing()
        self.vae.enable_tiling()  # of pictures larger than a tile
        self.vae.tile_sample_min_size, self.vae.tile_latent_min_size = self.tile, self.tile // self.reduction

    def encode(self, image: np.ndarray) -> torch.Tensor:
        """Encode a picture (H, W, 3) in [0, 1] with sides that are multiples of `multiple`.

        Returns the latent (1, 4, h, w), the mode of the VAE's posterior times its scaling factor.
        """
        with deterministic(self.device):
            planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].to(self.device, torch.float32)
            return self.vae.encode(planes * 2 - 1).latent_dist.mode() * self.vae.config.scaling_factor

    def sample(self, condition: torch.Tensor, seeds: list[int], steps: int) -> np.ndarray:
        """Draw one sample per seed, whose value does not depend on the other samples in its batch.

        Returns decoded samples (K, prompts * targets, H, W, 3), float32 in [0, 1]; NaN where the model overflowed.
        """
        self.scheduler.set_timesteps(steps, device=self.device)
        batches = [seeds[i : i + self.batch] for i in range(0, len(seeds), self.batch)]

        def one(batch: list[int]) -> np.ndarray:
            with torch.inference_mode():
                return np.concatenate([self._decode(self._denoise(condition, text, batch)) for text in self.text], 1)

        with deterministic(self.device), ThreadPoolExecutor(self.workers) as pool:
            return np.concatenate(list(pool.map(one, batches)))

    def _denoise(self, condition: torch.Tensor, text: torch.Tensor, seeds: list[int]) -> torch.Tensor:
        count, (height, width) = len(seeds), condition.shape[-2:]
        latent = _noise(seeds, self.unet.config.out_channels, height, width).to(self.device)
        latent = latent * self.scheduler.init_noise_sigma
        image, text = condition.expand(count, -1, -1, -1), text.expand(count, -1, -1)
        for step in self.scheduler.timesteps:
            noisy = self.scheduler.scale_model_input(latent, step)
            both = torch.cat([image, noisy] if self.recipe.condition_first else [noisy, image], 1).to(self.dtype)

            def velocity(rows: slice, columns: slice, both: torch.Tensor = both, step: torch.Tensor = step) -> torch.Tensor:
                return self.unet(both[..., rows, columns], step, encoder_hidden_states=text).sample.float()

            answer = blend_tiles(velocity, height, width, self.tile // self.reduction)
            latent = self.scheduler.step(answer, step, latent, eta=0.0).prev_sample
        return latent

    def _decode(self, latent: torch.Tensor) -> np.ndarray:
        count, channels, height, width = latent.shape
        parts = latent.reshape(-1, self.vae.config.latent_channels, height, width) / self.vae.config.scaling_factor
        pixels = self.vae.decode(parts).sample / 2 + 0.5
        pixels = torch.where(pixels.isfinite(), pixels.clamp(0, 1), torch.nan)
        shape = (count, -1, 3, height * self.reduction, width * self.reduction)
        return pixels.reshape(shape).permute(0, 1, 3, 4, 2).float().cpu().numpy()


def _noise(seeds: list[int], channels: int, height: int, width: int) -> torch.Tensor:
    """Draw (K, channels, height, width) float32, each from its own generator on the CPU, so that devices do not differ."""
    draws = [torch.randn(1, channels, height, width, generator=torch.Generator("cpu").manual_seed(seed)) for seed in seeds]
    return torch.cat(draws)


def predict_maps(recipe: Recipe, prior: SimpleNamespace, photo: np.ndarray, longest: int, steps: int, seed: int) -> np.ndarray:
    """Predict maps of a photograph; sample k has the noise of seed + k, the same for all photographs of a size and all maps.

    Args:
        recipe: of the model.
        prior: settings section.
        photo: (H, W, 3) in [0, 1].
        longest: longer side of the picture that the model receives, pixels.
        steps: of DDIM.
        seed: of the first sample.

    Returns:
        (K, prompts * targets, H, W, 3) in [0, 1].

    Raises:
        InputError: the checkpoint cannot be used, or the GPU's memory is not enough.
    """
    model = load_model(recipe, json.dumps(vars(prior), sort_keys=True))
    height, width = photo.shape[:2]
    wide, high = working_size(width, height, longest)
    try:
        condition = model.encode(pad(resize(photo[None], wide, high)[0], model.multiple))
        maps = model.sample(condition, [seed + k for k in range(prior.samples)], steps)[:, :, :high, :wide]
    except torch.OutOfMemoryError:
        raise InputError(
            f"the GPU's memory does not hold {model.batch} samples of {wide}x{high} at once: lower `prior.batch`,"
            " or set `prior.device: cpu`"
        ) from None
    # The weights of the filter sum to up to 1 + 1e-7; NaN stays.
    flat = np.clip(resize(maps.reshape(-1, high, wide, 3), width, height), 0, 1)
    return flat.reshape(*maps.shape[:2], height, width, 3)


def describe_model(recipe: Recipe, prior: SimpleNamespace) -> dict[str, Any]:
    """Return facts about the model: source, revision, licence, device, precision and versions."""
    model = load_model(recipe, json.dumps(vars(prior), sort_keys=True))
    gpu = model.device.type == "cuda"
    return {
        "checkpoint": prior.checkpoint,
        "published_as": recipe.repository,
        "revision": model.checkpoint.revision,
        "licence": recipe.licence,
        "device": torch.cuda.get_device_name(model.device) if gpu else "cpu",
        "precision": {"unet": str(model.dtype).removeprefix("torch."), "vae": "float32"},
        "batch": model.batch,
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }


@lru_cache(1)
def load_model(recipe: Recipe, prior: str) -> Model:
    """Load the model of a settings section (as JSON) and keep it for the next view."""
    return Model(recipe, SimpleNamespace(**json.loads(prior)))


# ---------------------------------------------------------------------------------------------------------------- loading


def _embeddings(checkpoint: Checkpoint, recipe: Recipe) -> list[torch.Tensor]:
    """Return the embedding (1, tokens, channels) of each prompt; the text encoder is not kept."""
    from transformers import CLIPTextModel, CLIPTokenizer

    encoder = load_network(checkpoint, "text_encoder", CLIPTextModel, dtype=torch.float32)
    try:
        tokenizer = CLIPTokenizer.from_pretrained(checkpoint.folder / "tokenizer", local_files_only=True)
    except Exception as error:  # as in load_network
        raise InputError(f"{checkpoint.folder / 'tokenizer'}: not loaded as CLIPTokenizer ({error})") from error
    padding, longest = "max_length" if recipe.fill_prompts else "do_not_pad", encoder.config.max_position_embeddings
    out = []
    for prompt in recipe.prompts:
        tokens = tokenizer(prompt, padding=padding, max_length=longest, truncation=True, return_tensors="pt")
        with torch.inference_mode():
            out.append(encoder(tokens.input_ids)[0])
    return out


def _precision(name: str, device: torch.device) -> torch.dtype:
    if name == "auto":
        return torch.float16 if device.type == "cuda" else torch.float32
    if name == "float16" and device.type == "cpu":
        raise InputError("`prior.precision`: found float16, which is for GPUs, and the device is a CPU; set `precision: auto`")
    return PRECISIONS[name]
