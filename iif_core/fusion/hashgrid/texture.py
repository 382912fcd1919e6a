"""The texture that the two backends make."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.hashgrid.levels import HashGridOptions, initial, layout, named_zeros
from iif_core.fusion.hashgrid.numba_engine import NumbaEngine
from iif_core.fusion.hashgrid.torch_engine import TorchEngine

if TYPE_CHECKING:
    import torch


class HashGridTexture:
    """Texture f(u): (N, 3) float32 in [0, 1]^3 -> (N, outputs) float32, trained by its own Adam.

    The outputs compose with any torch graph; `backward` of that graph adds to gradients kept here (not to `.grad` of
    the coordinates, which are constants), `step` uses and zeroes them. Same input and seed give the same bytes on the
    CPU for any number of threads (CUDA adds table gradients in no fixed order).

    `backend`: "numba" (CPU), "torch" (any device), or None: numba on the CPU if `features` is 2, else torch.
    Network weights start uniform in +-sqrt(6 / (inputs + outputs)) of the layer, biases at 0. Raises InputError.
    """

    def __init__(
        self,
        options: HashGridOptions | None = None,
        seed: int = 0,
        device: str = "cpu",
        threads: int = 2,
        backend: str | None = None,
    ) -> None:
        self.options = options or HashGridOptions()
        self.levels = layout(self.options)
        on_cpu = str(device).startswith("cpu")
        if backend is None:
            backend = "numba" if on_cpu and self.options.features == 2 else "torch"
        if threads < 1:
            raise InputError(f"hash grid: {threads} threads; at least 1")
        start = initial(self.options, self.levels, seed)
        if backend == "numba":
            if not on_cpu or self.options.features != 2:
                raise InputError(
                    f"hash grid: the numba backend runs on the CPU with 2 features; asked for device {device}, "
                    f"{self.options.features} features. Use backend='torch'"
                )
            self._engine: NumbaEngine | TorchEngine = NumbaEngine(self.options, self.levels, start, threads)
        elif backend == "torch":
            self._engine = TorchEngine(self.options, self.levels, start, device)
        else:
            raise InputError(f"hash grid: backend {backend!r}; known are 'numba', 'torch'")
        self.backend = backend

    def __call__(self, u: torch.Tensor) -> torch.Tensor:
        """Raw outputs (N, outputs) float32 at u (N, 3), clamped to [0, 1 - 1e-6]; N may be 0.

        Raises InputError for another shape, an integer type, coordinates that ask for a gradient or are not finite.
        """
        return self._engine.apply(self._checked(u))

    def evaluate(self, u: torch.Tensor, chunk: int = 1 << 17) -> torch.Tensor:
        """The same without a graph, `chunk` samples at a time: memory beyond the result does not grow with N."""
        import torch

        if chunk < 1:
            raise InputError(f"hash grid: chunk of {chunk} samples; at least 1")
        u = self._checked(u)
        out = torch.empty((len(u), self.options.outputs), dtype=torch.float32, device=u.device)
        with torch.no_grad():
            for low in range(0, len(u), chunk):
                out[low : low + chunk] = self._engine.apply(u[low : low + chunk])
        return out

    def step(self, lr: float, beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-8) -> None:
        """One Adam update of table and network with the gradients gathered since the last one, then zeroes them.

        As torch.optim.Adam on dense gradients: entries without a gradient go on by their momentum.
        """
        if not (0 < lr < math.inf and 0 <= beta1 < 1 and 0 <= beta2 < 1 and eps > 0):
            raise InputError(f"hash grid: lr {lr}, beta {beta1}, {beta2}, eps {eps}; need lr, eps > 0 and 0 <= beta < 1")
        self._engine.step(lr, beta1, beta2, eps)

    def gradients(self) -> dict[str, NDArray]:
        """Copies of the gradients gathered since the last step, by the names of `state`; for tests and diagnosis."""
        return self._engine.gradients()

    def zero_grad(self) -> None:
        """Forgets the gradients gathered since the last step."""
        self._engine.zero_grad()

    def state(self) -> dict[str, NDArray]:
        """Copies of parameters and Adam moments, float32, the same for both backends.

        "table" (entries, features), levels one after another; "weight_i" (outputs, inputs), "bias_i"; each also as
        "first.<name>", "second.<name>"; "steps": number of updates so far. Gradients are not part of it.
        """
        return self._engine.state()

    def load_state(self, state: dict[str, NDArray]) -> None:
        """Takes over what `state` gave, of any backend, and forgets gathered gradients. Raises InputError."""
        expected = {name: value.shape for name, value in named_zeros(self.options, self.levels).items()}
        expected = {prefix + name: shape for name, shape in expected.items() for prefix in ("", "first.", "second.")}
        expected["steps"] = ()
        found = {name: np.shape(value) for name, value in state.items()}
        if found != expected:
            wrong = sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))
            raise InputError(
                f"hash grid: state does not fit the options at {', '.join(wrong)}: "
                f"found {[found.get(name) for name in wrong]}, needed {[expected.get(name) for name in wrong]}"
            )
        self._engine.load_state(state)

    def _checked(self, u: torch.Tensor) -> torch.Tensor:
        import torch

        if not isinstance(u, torch.Tensor) or u.ndim != 2 or u.shape[1] != 3 or not u.is_floating_point():
            found = f"{u.dtype} {tuple(u.shape)}" if isinstance(u, torch.Tensor) else type(u).__name__
            raise InputError(f"hash grid: coordinates are {found}; needed is a floating tensor (N, 3)")
        if u.requires_grad:
            raise InputError("hash grid: coordinates ask for a gradient, which is not computed; pass u.detach()")
        if u.device.type != self._engine.device.type:
            raise InputError(f"hash grid: coordinates are on {u.device}, the texture is on {self._engine.device}")
        return u.to(torch.float32)
