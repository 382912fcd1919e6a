"""Loads networks from checked checkpoints and makes their results reproducible."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from iif_core.errors import InputError
from workflow.models.checkpoint import Checkpoint, Origin, setting_as_yaml


def load_network(checkpoint: Checkpoint, component: str, kind: Any, **more: Any) -> torch.nn.Module:
    """Load a network and refuse missing weights, which `from_pretrained` alone would draw at random.

    Args:
        checkpoint: checked.
        component: folder of the network in the checkpoint; empty for the checkpoint itself.
        kind: class of the library.
        **more: arguments of `from_pretrained`.

    Returns:
        The network in evaluation mode, without gradients.

    Raises:
        InputError: not loadable, or weights missing or of another shape.
    """
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
    except Exception as error:  # the libraries raise a dozen types of exceptions
        first = str(error).strip().split("\n", 1)[0]
        raise InputError(f"{folder}: not loaded as {kind.__name__} ({type(error).__name__}: {first})") from error
    lost = [*info["missing_keys"], *(str(entry[0]) for entry in info["mismatched_keys"])]
    if lost:
        raise InputError(
            f"{folder}: {len(lost)} weights missing or of another shape, such as {sorted(lost)[0]}; config.json and weights do"
            " not belong together, download the checkpoint again"
        )
    return network.eval().requires_grad_(False)


def named_device(name: str, origin: Origin) -> torch.device:
    """Return the device that a setting names: `auto`, `cpu` or `cuda`.

    Raises:
        InputError: `cuda`, but there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            f"`{origin.section}.device`: found cuda, but torch sees no CUDA device here; set"
            f" {setting_as_yaml(origin.section, 'device: auto')}"
        )
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


@contextmanager
def deterministic(device: torch.device) -> Iterator[None]:
    """Compute without gradients and without choosing kernels by timing.

    On a CPU every batch runs on one thread, because the number of threads that share a convolution affects its last bits.
    """
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
    """Keep progress bars and advice of Hugging Face's libraries, but not their errors, out of the log."""
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
