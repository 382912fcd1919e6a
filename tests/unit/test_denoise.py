"""The denoiser is loaded without torch, whose import takes longer than denoising a scene."""

import importlib.util
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("pyoidn") is None, reason="needs Intel Open Image Denoise (pyoidn)")

DENOISED = """
import sys
import numpy as np
from lab.simulated.denoise import denoise_alone
from workflow.models.denoise import denoise

noisy = np.random.default_rng(0).exponential(1.0, (64, 64, 3)).astype(np.float32)
flat = np.full_like(noisy, 0.5)
for picture in (denoise(noisy, flat, flat), denoise_alone(noisy)):
    assert picture.shape == noisy.shape and np.std(picture) < 0.5 * np.std(noisy), np.std(picture)
assert "torch" not in sys.modules, "torch was imported, or its name is blocked for good"
import torch

assert torch.ones(2).sum() == 2
assert denoise(noisy, flat, flat).shape == noisy.shape
"""


@pytest.mark.long
def test_denoiser_leaves_torch_alone(repository):
    subprocess.run([sys.executable, "-c", DENOISED], cwd=repository, check=True)
