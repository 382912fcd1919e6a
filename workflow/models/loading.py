"""Networks from checked checkpoints, on a device, computing the same whenever they are asked."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from iif_core.errors import InputError
from workflow.models.checkpoint import Checkpoint, Origin, written


def network(checkpoint: Checkpoint, component: str, kind: Any, **more: Any) -> torch.nn.Module:
    """A network with every one of its weights from the checkpoint; from_pretrained alone would draw missing ones at random."""
    folder = checkpoint.folder / component
    try:
        network, info = kind.from_pretrained(
            folder,
            variant=checkpoint.variant(component),
            use_safetensors=True,
            local_files_only=True,
            output_loading_info=True,
            **more,
        )
    except Exception as error:  # the libraries raise what they meet, of a dozen types
        first = str(error).strip().split("\n", 1)[0]
        raise InputError(f"{folder}: not loaded as {kind.__name__} ({type(error).__name__}: {first})") from error
    lost = [*info["missing_keys"], *(str(entry[0]) for entry in info["mismatched_keys"])]
    if lost:
        raise InputError(
            f"{folder}: {len(lost)} weights missing or of another shape, such as {sorted(lost)[0]}; config.json and weights do"
            " not belong together, download the checkpoint again"
        )
    return network.eval().requires_grad_(False)


def device_named(name: str, origin: Origin) -> torch.device:
    """The device of a setting."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            f"`{origin.section}.device`: found cuda, but torch sees no CUDA device here; set"
            f" {written(origin.section, 'device: auto')}"
        )
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


@contextmanager
def exact(device: torch.device) -> Iterator[None]:
    """No gradients, no choice of kernels by timing. On a CPU one thread a batch: how many threads share a convolution
    decides its last bits, so batches are what runs side by side."""
    threads = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(1)
    try:
        with torch.inference_mode(), torch.backends.cudnn.flags(True, False, deterministic=True, allow_tf32=False):
            yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def quiet(*libraries: str) -> Iterator[None]:
    """Progress bars and advice of Hugging Face's libraries stay out of the log; errors do not."""
    logs = [importlib.import_module(f"{name}.utils.logging") for name in libraries]
    levels = [log.get_verbosity() for log in logs]
    for log in logs:
        log.set_verbosity_error()
        log.disable_progress_bar()
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.set_verbosity(level)
