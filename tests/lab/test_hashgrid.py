"""Hash-grid texture: compared with a plain float64 reference, torch's Adam and other numbers of threads; edge cases."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from lab.published.adam import adam_factors
from lab.published.fusion.hashgrid import texture as hashgrid_texture
from lab.published.fusion.hashgrid.levels import ROWS, HashGridOptions, layout, widths_of
from tests.errors import refused
from tests.oracles.torch_hashgrid import TorchTexture

# direct levels (7, 11 vertices: 343, 1331 entries) and hashed ones; odd sizes everywhere, collisions
SMALL = HashGridOptions(
    levels=5, log2_entries=11, base_resolution=7, growth=1.55, hidden=10, hidden_layers=2, outputs=3, init_scale=0.5
)


def points(n, seed=0):
    """Half on walls (corners and edges of the cube among them), half anywhere, some outside."""
    random = np.random.default_rng(seed)
    u = random.random((n, 3), dtype=np.float32)
    u[: n // 2, 0] = random.choice(np.float32([0, 0.25, 1]), n // 2)
    u[: n // 4, 1] = random.choice(np.float32([-0.5, 0, 1, 1.5]), n // 4)
    return torch.from_numpy(u)


def parameters(texture, dtype=torch.float64):
    named = {k: v for k, v in texture.state().items() if k.startswith(("table", "weight", "bias"))}
    return {name: torch.tensor(value, dtype=dtype, requires_grad=True) for name, value in named.items()}


def reference(options, named, u):
    """Eqs. F.57 to F.59 in float64, with integers that do not wrap."""
    u = u.to(torch.float32).clamp(0, 1 - 1e-6)
    features, start = [], 0
    for level in layout(options):
        # cell and weight are cut from the float32 position: a finer level must fall into the same cell
        position = (u * np.float32(level.resolution - 1)).to(torch.float64)
        cell = position.to(torch.int64).clamp(max=level.resolution - 2)
        weight = position - cell
        value = 0
        for corner in range(8):
            offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            x, y, z = (cell + offset).unbind(1)
            if level.resolution**3 > 2**options.log2_entries:
                row = ((x ^ (y * 2654435761) ^ (z * 805459861)) % 2**options.log2_entries) + start
            else:
                row = x + level.resolution * (y + level.resolution * z) + start
            w = torch.where(offset == 1, weight, 1 - weight).prod(1)
            value = value + w[:, None] * named["table"][row]
        features.append(value)
        start += min(level.resolution**3, 2**options.log2_entries)
    x = torch.cat(features, 1)
    for i in range(options.hidden_layers + 1):
        x = x @ named[f"weight_{i}"].T + named[f"bias_{i}"]
        x = x if i == options.hidden_layers else torch.relu(x)
    return x


def test_layout_and_parameter_count_are_the_papers():
    levels = layout(HashGridOptions())
    assert [levels[i].resolution for i in (0, 6, 7)] == [16, 78, 101]
    assert levels[31].resolution == pytest.approx(54_500, rel=1e-3)
    assert [level.hashed for level in levels] == [False] * 7 + [True] * 25
    assert 2 * sum(level.entries for level in levels) == 27_954_106
    assert widths_of(HashGridOptions(), levels) == [64, 64, 64, 10]
    assert all(level.start % ROWS == 0 for level in levels)


@pytest.mark.parametrize(
    "options",
    [SMALL, replace(SMALL, levels=1, hidden_layers=1, outputs=1), replace(SMALL, levels=2, hidden_layers=3, hidden=9, outputs=5)],
)
def test_outputs_and_gradients_equal_reference(options):
    texture = TorchTexture(options, seed=3)
    named = parameters(texture)
    u = points(1300)  # more than two blocks, the last not full
    other = torch.linspace(0.5, 1.5, options.outputs, requires_grad=True)
    other64 = other.detach().double().requires_grad_()

    y, expected = texture(u), reference(options, named, u)
    torch.testing.assert_close(y.double(), expected, atol=2e-6, rtol=1e-5)
    assert y.dtype == torch.float32 and y.shape == (1300, options.outputs)
    (torch.sin(3 * y) * other).sum().backward()
    (torch.sin(3 * expected) * other64).sum().backward()
    torch.testing.assert_close(other.grad.double(), other64.grad, atol=1e-3, rtol=1e-5)
    for name, gradient in texture.gradients().items():
        exact = named[name].grad.numpy()
        np.testing.assert_allclose(gradient, exact, atol=3e-6 * np.abs(exact).max(), rtol=2e-5, err_msg=name)


def test_gradient_equals_finite_differences():
    texture = TorchTexture(SMALL, seed=5)
    u = points(200)
    torch.tanh(texture(u)).sum().backward()
    gradients = texture.gradients()
    named = {name: value.detach() for name, value in parameters(texture).items()}
    random = np.random.default_rng(1)
    direction = {name: torch.from_numpy(random.normal(size=value.shape)) for name, value in named.items()}

    def loss(h):
        return torch.tanh(reference(SMALL, {k: v + h * direction[k] for k, v in named.items()}, u)).sum().item()

    along = sum((gradients[name] * direction[name].numpy()).sum() for name in named)
    h = 1e-8  # small against the distance of the nearest kink of the rectifiers
    assert along == pytest.approx((loss(h) - loss(-h)) / (2 * h), rel=2e-4)


def test_step_equals_torch_adam(monkeypatch):
    # these constants keep the difference of the moments' factors in float32 and float64 below the tolerances
    monkeypatch.setattr(hashgrid_texture, "adam_factors", partial(adam_factors, beta1=0.8, beta2=0.95, eps=1e-6))
    texture = TorchTexture(SMALL, seed=1)
    named = parameters(texture, torch.float32)
    optimiser = torch.optim.Adam(named.values(), betas=(0.8, 0.95), eps=1e-6)
    for i in range(6):
        u = points(40 + 300 * (i == 1), seed=i)
        strength = 0.0 if i == 3 else 1.0  # without a gradient, parameters move by their momentum
        (strength * texture(u) ** 2).sum().backward()
        for name, gradient in texture.gradients().items():  # Adam alone: sign(g) lr makes rounding of g large
            named[name].grad = torch.from_numpy(gradient)
        lr = 0.01 / (1 + i)
        optimiser.param_groups[0]["lr"] = lr
        optimiser.step()
        texture.step(lr)
    state = texture.state()
    for name, value in named.items():
        np.testing.assert_allclose(state[name], value.detach().numpy(), atol=2e-7, rtol=2e-6, err_msg=name)
        moments = optimiser.state[value]
        np.testing.assert_allclose(state["first." + name], moments["exp_avg"].numpy(), atol=1e-7, rtol=1e-5)
        np.testing.assert_allclose(state["second." + name], moments["exp_avg_sq"].numpy(), atol=1e-7, rtol=1e-5)
    untouched = state["first.table"] == 0
    assert untouched.any() and not untouched.all()


def test_queued_update_needs_no_gradients_call():
    """Scatter, update and encode in one visit of a level equal the three one after another."""
    short, long = (TorchTexture(SMALL, seed=2) for _ in range(2))
    for i in range(4):
        for texture in (short, long):
            (texture(points(700, seed=i)) ** 2).mean().backward()
            if texture is long:
                texture.gradients()
            texture.step(0.02)
            if texture is long:
                texture.state()
    assert_same_state(short.state(), long.state())


def assert_same_state(one, two):
    assert one.keys() == two.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def trained(threads, order=None):
    texture = TorchTexture(SMALL, seed=6, threads=threads)
    u = points(9000)
    for _ in range(3):
        y = texture(u if order is None else u[order])
        (y**2).mean().backward()
        texture.step(0.01)
    return texture


def test_same_bytes_for_any_number_of_threads():
    one, two, three = (trained(threads) for threads in (1, 2, 3))
    assert_same_state(one.state(), two.state())
    assert_same_state(one.state(), three.state())
    assert torch.equal(one.at(points(9000)), two.at(points(9000)))


def test_order_of_the_batch_matters_to_rounding_only(monkeypatch):
    # with a large eps, gradients that are 0 up to rounding move nothing
    monkeypatch.setattr(hashgrid_texture, "adam_factors", partial(adam_factors, eps=1e-3))
    order = torch.from_numpy(np.random.default_rng(0).permutation(9000))
    one, two = trained(2), trained(2, order)
    for name, value in one.state().items():
        np.testing.assert_allclose(two.state()[name], value, atol=1e-5, err_msg=name)
    u = points(9000)
    assert torch.equal(one.at(u)[order], one.at(u[order]))


def test_evaluate_in_chunks():
    texture = TorchTexture(SMALL, seed=7)
    u = points(1100)
    y = texture(u)
    assert y.requires_grad
    for chunk in (1, 7, 1100, 4000):
        out = texture.at(u[:90] if chunk == 1 else u, chunk)
        assert not out.requires_grad
        torch.testing.assert_close(out, y.detach()[: len(out)], atol=1e-6, rtol=1e-5)


def test_edges_of_the_batch():
    texture = TorchTexture(SMALL, seed=8)
    assert texture(torch.zeros((0, 3))).shape == texture.at(torch.zeros((0, 3))).shape == (0, 3)

    u = torch.tensor([[0.3, 0.6, 0.9]])
    texture(u).sum().backward()
    single = texture.gradients()
    texture = TorchTexture(SMALL, seed=8)
    many = texture(u.expand(5000, 3))
    torch.testing.assert_close(many, texture(u).expand_as(many), atol=1e-7, rtol=1e-5)
    many.sum().backward()
    for name, gradient in texture.gradients().items():
        np.testing.assert_allclose(gradient, 5000 * single[name], rtol=1e-3, atol=1e-3, err_msg=name)
    texture.step(0.1)
    assert all(np.isfinite(value).all() for value in texture.state().values())


def test_coordinates_outside_are_clamped():
    texture = TorchTexture(SMALL, seed=9)
    outside = torch.tensor([[-1e30, 0.5, 2.0], [-1e-9, 1.0, 1e30], [1.0, 1.0, 1.0]])
    torch.testing.assert_close(texture.at(outside), texture.at(outside.clamp(0, 1 - 1e-6)), atol=0, rtol=0)
    fine = TorchTexture(HashGridOptions(log2_entries=6, hidden=4))  # 54,500 per side
    assert torch.isfinite(fine.at(outside)).all()


@pytest.mark.parametrize("bad", [float("nan"), float("-inf")])
def test_bad_coordinates(bad):
    texture = TorchTexture(SMALL)
    before = texture.state()
    for use in (texture, texture.at):
        with refused("hash grid", "coordinates", "NaN"):
            use(torch.tensor([[0.1, bad, 0.2], [0.0, 0.0, 0.0]]))
    assert_same_state(before, texture.state())


def test_bad_batch_keeps_a_queued_update():
    texture, other = (TorchTexture(SMALL, seed=1) for _ in range(2))
    for each in (texture, other):
        each(points(50)).sum().backward()
        each.step(0.1)
    with refused("hash grid", "coordinates", "NaN"):
        texture(torch.full((1, 3), float("nan")))
    assert_same_state(texture.state(), other.state())


def test_fits_a_function():
    texture = TorchTexture(HashGridOptions(levels=6, log2_entries=12, base_resolution=8, growth=1.5, hidden=16, outputs=3))
    u = points(4000).clamp(0, 1)
    target = torch.stack([torch.sin(6 * u[:, 0]), u[:, 1] * u[:, 2], (u[:, 0] > 0.5).float()], 1)
    losses = []
    for _ in range(100):
        loss = ((texture(u) - target) ** 2).mean()
        losses.append(loss.item())
        loss.backward()
        texture.step(0.01)
    assert losses[-1] < losses[0] / 10
    assert ((texture.at(u) - target) ** 2).mean() < losses[0] / 10
