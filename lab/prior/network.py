"""The network that is trained: the product's, with weights that may come from an earlier training."""

from __future__ import annotations

import torch

from workflow.priors.network import PriorNetwork

HEAD = (
    "log_albedo_r",
    "log_albedo_g",
    "log_albedo_b",
    "roughness",
    "metallic",
    "scale_albedo",
    "scale_roughness",
    "scale_metallic",
)
"""What each head of the product's network predicts, in this order; scales are logarithms."""


def load_weights(network: PriorNetwork, arrays: dict[str, torch.Tensor]) -> None:
    """Load weights of the same layers and sizes.

    Raises:
        ValueError: weights of other layers or sizes.
    """
    own = network.state_dict()
    strange = [name for name, array in arrays.items() if name not in own or own[name].shape != array.shape]
    if strange or len(arrays) < len(own):
        named = strange or sorted(set(own) - set(arrays))
        raise ValueError(f"these weights are for another network: {', '.join(named[:4])}; give its widths and heads")
    network.load_state_dict({name: array.float() for name, array in arrays.items()})
