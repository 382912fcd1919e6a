"""The hash-grid texture, in front of its two engines."""

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

    The outputs compose with any torch graph. `backward` of that graph adds to gradients that are kept here (coordinates are
    constants and get none); `step` uses and zeroes them. The same input and seed give the same bytes on the CPU for any
    number of threads; CUDA adds the gradients of the table in no fixed order.

    Args:
        options: shape; None = the paper's. seed: of the initial parameters.
        device: torch device; threads: of the numba engine.
        backend: "numba" (CPU), "torch" (any device), or None = numba on the CPU if `features` is 2, else torch.

    Raises:
        InputError: an unknown engine or one that does not support the device or the options.
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
        """Return the raw outputs (N, outputs) float32 at u (N, 3), which is clamped to [0, 1 - 1e-6]; N may be 0.

        Raises:
            InputError: another shape, an integer type, coordinates that require a gradient or are not finite.
        """
        return self._engine.apply(self._checked(u))

    def evaluate(self, u: torch.Tensor, chunk: int = 1 << 17) -> torch.Tensor:
        """Return the raw outputs without a graph, computed for `chunk` samples at a time to limit memory."""
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
        """Update table and network by Adam (Eq. F.55) with the gradients since the last step, and zero them.

        Args:
            lr: learning rate; beta1, beta2: decay of the moments; eps: added to the root of the second one.

        Raises:
            InputError: numbers out of range.
        """
        if not (0 < lr < math.inf and 0 <= beta1 < 1 and 0 <= beta2 < 1 and eps > 0):
            raise InputError(f"hash grid: lr {lr}, beta {beta1}, {beta2}, eps {eps}; need lr, eps > 0 and 0 <= beta < 1")
        self._engine.step(lr, beta1, beta2, eps)

    def gradients(self) -> dict[str, NDArray]:
        """Return copies of the gradients since the last step, by the names of `state`; for tests and diagnosis."""
        return self._engine.gradients()

    def zero_grad(self) -> None:
        """Discard the gradients since the last step."""
        self._engine.zero_grad()

    def state(self) -> dict[str, NDArray]:
        """Return copies of parameters and Adam moments, float32, in one form for both engines.

        "table" (entries, features) holds levels one after another; "weight_i" is (outputs, inputs), "bias_i" (outputs,); the
        moments are "first.<name>" and "second.<name>"; "steps" is the number of updates. Gradients are not included.
        """
        return self._engine.state()

    def load_state(self, state: dict[str, NDArray]) -> None:
        """Take over the `state` of a texture of any engine and discard gradients; InputError if it has other shapes."""
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
