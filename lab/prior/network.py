"""The network that is trained: the product's, and at will a mixture weight for each hypothesis."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

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
WEIGHT = "weight"
"""The further output of networks with mixture weights: the logit of a head, averaged over the pixels of an object."""


class WeightedNetwork(PriorNetwork):
    """A network whose heads have mixture weights, in a layer `mixture` that older weights lack.

    Args:
        channels, widths, heads: as of `PriorNetwork`.
    """

    def __init__(self, channels: int, widths: Sequence[int], heads: int):
        super().__init__(channels, widths, heads)
        self.mixture = nn.Conv2d(widths[0], heads, 1)
        nn.init.zeros_(self.mixture.weight)
        nn.init.zeros_(self.mixture.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Predict (B, M, 9, H, W) float32 from inputs (B, C, H, W): what `PriorNetwork` predicts, and the logit of each head."""
        f = self.features(x)
        logits = self.mixture(f).float()[:, :, None]
        return torch.cat([self.read_out(f, x[:, :3].float()), logits], 2)


def outputs_of(network: PriorNetwork) -> tuple[str, ...]:
    """Return the names of what each head predicts, as `recipe.json` lists them."""
    return (*HEAD, WEIGHT) if isinstance(network, WeightedNetwork) else HEAD


def build(channels: int, widths: Sequence[int], heads: int, outputs: Sequence[str] = (*HEAD, WEIGHT)) -> PriorNetwork:
    """Make a network with the outputs that a recipe lists.

    Raises:
        ValueError: other outputs than these modules predict.
    """
    kinds = {HEAD: PriorNetwork, (*HEAD, WEIGHT): WeightedNetwork}
    if tuple(outputs) not in kinds:
        raise ValueError(f"outputs {list(outputs)}; known: {', '.join(HEAD)}, and perhaps {WEIGHT}")
    return kinds[tuple(outputs)](channels, widths, heads)


def load_weights(network: PriorNetwork, arrays: dict[str, torch.Tensor]) -> list[str]:
    """Load weights of the same sizes; layers that they lack keep their start.

    Returns:
        Names of the layers that keep their start.

    Raises:
        ValueError: weights of other sizes, or layers that the network does not have.
    """
    own = network.state_dict()
    strange = [name for name, array in arrays.items() if name not in own or own[name].shape != array.shape]
    if strange:
        raise ValueError(f"these weights are for another network: {', '.join(strange[:4])}; give its widths and heads")
    network.load_state_dict({name: array.float() for name, array in arrays.items()}, strict=False)
    return sorted(set(own) - set(arrays))
