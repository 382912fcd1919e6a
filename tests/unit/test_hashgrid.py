"""Hash-grid texture: compared with a plain float64 reference, torch's Adam, other threads and engines; edge cases."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from iif_core.errors import InputError
from iif_core.fusion.hashgrid import numba_engine
from iif_core.fusion.hashgrid.levels import ROWS, HashGridOptions, layout, parameter_counts
from iif_core.fusion.hashgrid.texture import HashGridTexture

# direct levels (7, 11 vertices: 343, 1331 entries) and hashed ones; odd sizes everywhere, collisions
SMALL = HashGridOptions(
    levels=5, log2_entries=11, base_resolution=7, growth=1.55, hidden=10, hidden_layers=2, outputs=3, init_scale=0.5
)
BACKENDS = ("numba", "torch")


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
    encoding, network = parameter_counts(HashGridOptions())
    assert encoding / 1e6 == pytest.approx(27.95, abs=0.005)
    assert network == 64 * 64 + 64 + 64 * 64 + 64 + 64 * 10 + 10
    assert all(level.start % ROWS == 0 for level in levels)


def test_cap_ends_the_levels_at_the_first_that_reaches_it():
    full = [level.resolution for level in layout(HashGridOptions())]
    capped = [level.resolution for level in layout(HashGridOptions(finest=101))]
    assert capped == full[:8]
    assert [level.resolution for level in layout(HashGridOptions(finest=100))] == [*full[:7], 100]
    assert [level.resolution for level in layout(HashGridOptions(finest=4))] == [4]
    assert [level.resolution for level in layout(HashGridOptions(finest=1 << 20))] == full
    texture = HashGridTexture(replace(SMALL, finest=2))
    assert texture.state()["table"].shape == (8, 2)
    torch.testing.assert_close(
        texture(points(9)).double(), reference(replace(SMALL, finest=2), parameters(texture), points(9)), atol=1e-6, rtol=1e-5
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "options",
    [SMALL, replace(SMALL, levels=1, hidden_layers=1, outputs=1), replace(SMALL, levels=2, hidden_layers=3, hidden=9, outputs=5)],
)
def test_outputs_and_gradients_equal_reference(backend, options):
    texture = HashGridTexture(options, seed=3, backend=backend)
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
    texture = HashGridTexture(SMALL, seed=5)
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


@pytest.mark.parametrize("backend", BACKENDS)
def test_step_equals_torch_adam(backend):
    texture = HashGridTexture(SMALL, seed=1, backend=backend)
    named = parameters(texture, torch.float32)
    optimiser = torch.optim.Adam(named.values(), lr=1, betas=(0.8, 0.95), eps=1e-6)
    for i in range(6):
        if i != 3:  # without a gradient, parameters move by their momentum
            u = points(40 + 300 * (i == 1), seed=i)
            (texture(u) ** 2).sum().backward()
        optimiser.zero_grad()
        for name, gradient in texture.gradients().items():  # Adam alone: sign(g) lr makes rounding of g large
            named[name].grad = torch.from_numpy(gradient)
        lr = 0.01 / (1 + i)
        optimiser.param_groups[0]["lr"] = lr
        optimiser.step()
        texture.step(lr, 0.8, 0.95, 1e-6)
    state = texture.state()
    assert state["steps"] == 6
    for name, value in named.items():
        np.testing.assert_allclose(state[name], value.detach().numpy(), atol=2e-7, rtol=2e-6, err_msg=name)
        moments = optimiser.state[value]
        np.testing.assert_allclose(state["first." + name], moments["exp_avg"].numpy(), atol=1e-7, rtol=1e-5)
        np.testing.assert_allclose(state["second." + name], moments["exp_avg_sq"].numpy(), atol=1e-7, rtol=1e-5)
    untouched = state["first.table"] == 0
    assert untouched.any() and not untouched.all()
    assert not any(gradient.any() for gradient in texture.gradients().values())


def test_queued_update_needs_no_gradients_call():
    """Scatter, update and encode in one visit of a level equal the three one after another."""
    short, long = (HashGridTexture(SMALL, seed=2) for _ in range(2))
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


@pytest.mark.parametrize("backend", BACKENDS)
def test_backward_passes_add_up(backend, monkeypatch):
    if backend == "numba":
        monkeypatch.setattr(numba_engine, "MAX_PENDING_SAMPLES", 700)  # the third pass is scattered early, the last waits
    parts, whole = (HashGridTexture(SMALL, seed=2, backend=backend) for _ in range(2))
    batches = [points(n, seed=n) for n in (300, 200, 250, 10)]
    graphs = [(parts(u) ** 3).sum() for u in batches]
    for graph in reversed(graphs):
        graph.backward()
    (whole(torch.cat(batches)) ** 3).sum().backward()
    expected = whole.gradients()
    for name, gradient in parts.gradients().items():
        np.testing.assert_allclose(gradient, expected[name], atol=1e-5 * np.abs(expected[name]).max(), err_msg=name)
    graph = (parts(batches[0]) ** 3).sum()
    graph.backward(retain_graph=True)
    graph.backward()
    parts.zero_grad()
    assert not any(gradient.any() for gradient in parts.gradients().values())


def test_backends_agree_after_training():
    textures = [HashGridTexture(replace(SMALL, init_scale=0.1), seed=4, backend=backend) for backend in BACKENDS]
    u = points(600)
    assert_same_state(textures[0].state() | {"steps": 0}, textures[1].state() | {"steps": 0})
    for texture in textures:
        for _ in range(3):
            ((texture(u) - 1) ** 2).mean().backward()
            texture.step(0.01, eps=1e-3)  # large eps: gradients that are 0 up to rounding move nothing
    y = [texture.evaluate(u) for texture in textures]
    torch.testing.assert_close(*y, atol=1e-5, rtol=1e-4)


def trained(threads, order=None):
    texture = HashGridTexture(SMALL, seed=6, threads=threads)
    u = points(9000)
    for _ in range(3):
        y = texture(u if order is None else u[order])
        (y**2).mean().backward()
        texture.step(0.01, eps=1e-3)
    return texture


def test_same_bytes_for_any_number_of_threads():
    one, two, three = (trained(threads) for threads in (1, 2, 3))
    assert_same_state(one.state(), two.state())
    assert_same_state(one.state(), three.state())
    assert torch.equal(one.evaluate(points(9000)), two.evaluate(points(9000)))


def test_order_of_the_batch_matters_to_rounding_only():
    order = torch.from_numpy(np.random.default_rng(0).permutation(9000))
    one, two = trained(2), trained(2, order)
    for name, value in one.state().items():
        np.testing.assert_allclose(two.state()[name], value, atol=1e-5, err_msg=name)
    u = points(9000)
    assert torch.equal(one.evaluate(u)[order], one.evaluate(u[order]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_evaluate_in_chunks(backend):
    texture = HashGridTexture(SMALL, seed=7, backend=backend)
    u = points(1100)
    with torch.enable_grad():
        y = texture(u)
    assert y.requires_grad
    for chunk in (1, 7, 1100, 4000)[backend == "torch" :]:
        out = texture.evaluate(u[:90] if chunk == 1 else u, chunk)
        assert not out.requires_grad
        torch.testing.assert_close(out, y.detach()[: len(out)], atol=1e-6, rtol=1e-5)
    with pytest.raises(InputError, match="chunk"):
        texture.evaluate(u, 0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_edges_of_the_batch(backend):
    texture = HashGridTexture(SMALL, seed=8, backend=backend)
    empty = texture(torch.zeros((0, 3)))
    assert empty.shape == (0, 3)
    empty.sum().backward()
    assert not any(gradient.any() for gradient in texture.gradients().values())
    assert texture.evaluate(torch.zeros((0, 3))).shape == (0, 3)

    u = torch.tensor([[0.3, 0.6, 0.9]])
    one = texture(u)
    one.sum().backward()
    single = texture.gradients()
    texture.zero_grad()
    many = texture(u.expand(5000, 3))
    torch.testing.assert_close(many, one.expand_as(many), atol=1e-7, rtol=1e-5)
    many.sum().backward()
    for name, gradient in texture.gradients().items():
        np.testing.assert_allclose(gradient, 5000 * single[name], rtol=1e-3, atol=1e-3, err_msg=name)
    texture.step(0.1)
    assert all(np.isfinite(value).all() for value in texture.state().values())


@pytest.mark.parametrize("backend", BACKENDS)
def test_coordinates_outside_are_clamped(backend):
    texture = HashGridTexture(SMALL, seed=9, backend=backend)
    outside = torch.tensor([[-1e30, 0.5, 2.0], [-1e-9, 1.0, 1e30], [1.0, 1.0, 1.0]])
    torch.testing.assert_close(texture.evaluate(outside), texture.evaluate(outside.clamp(0, 1 - 1e-6)), atol=0, rtol=0)
    fine = HashGridTexture(HashGridOptions(log2_entries=6, hidden=4), backend=backend)  # 54,500 per side
    assert torch.isfinite(fine.evaluate(outside)).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("u", "message"),
    [
        (torch.tensor([[0.1, float("nan"), 0.2], [0.0, 0.0, 0.0]]), "finite"),
        (torch.tensor([[0.1, float("-inf"), 0.2]]), "finite"),
        (torch.zeros((4, 2)), r"\(N, 3\)"),
        (torch.zeros((4, 3), dtype=torch.int32), "int32"),
        (np.zeros((4, 3), np.float32), "ndarray"),
        (torch.zeros((4, 3), requires_grad=True), "detach"),
    ],
)
def test_bad_coordinates(backend, u, message):
    texture = HashGridTexture(SMALL, backend=backend)
    before = texture.state()
    for use in (texture, texture.evaluate):
        with pytest.raises(InputError, match=message):
            use(u)
    assert_same_state(before, texture.state())


def test_bad_batch_keeps_a_queued_update():
    texture, other = (HashGridTexture(SMALL, seed=1) for _ in range(2))
    for each in (texture, other):
        each(points(50)).sum().backward()
        each.step(0.1)
    with pytest.raises(InputError, match="finite"):
        texture(torch.full((1, 3), float("nan")))
    assert_same_state(texture.state(), other.state())


@pytest.mark.parametrize(
    "change",
    [{"levels": 0}, {"log2_entries": 40}, {"base_resolution": 1}, {"growth": 0.5}, {"hidden_layers": 0}, {"finest": 1}]
    + [{"init_scale": float("nan")}],
)
def test_bad_options(change):
    with pytest.raises(InputError, match=next(iter(change))):
        replace(SMALL, **change)


def test_backward_after_step_is_refused():
    texture = HashGridTexture(SMALL)
    graphs = [texture(points(10)).sum() for _ in range(2)]
    graphs[0].backward()
    texture.step(0.1)
    with pytest.raises(InputError, match="between"):
        graphs[1].backward()


def test_bad_uses():
    with pytest.raises(InputError, match="finest"):
        layout(HashGridOptions(growth=2))
    with pytest.raises(InputError, match="backend='torch'"):
        HashGridTexture(replace(SMALL, features=4), backend="numba")
    with pytest.raises(InputError, match="numpy"):
        HashGridTexture(SMALL, backend="numpy")
    with pytest.raises(InputError, match="threads"):
        HashGridTexture(SMALL, threads=0)
    for bad in ({"lr": 0}, {"lr": float("nan")}, {"lr": 0.1, "beta1": 1}, {"lr": 0.1, "eps": 0}):
        with pytest.raises(InputError, match="lr"):
            HashGridTexture(SMALL).step(**bad)


def test_other_feature_counts_use_torch():
    options = replace(SMALL, features=3)
    texture = HashGridTexture(options)
    assert texture.backend == "torch"
    u = points(50)
    torch.testing.assert_close(texture(u).double(), reference(options, parameters(texture), u), atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize(("first", "second"), [("numba", "numba"), ("numba", "torch"), ("torch", "numba")])
def test_state_goes_on_where_it_was_saved(first, second):
    u = points(500)

    def train(texture, steps):
        for _ in range(steps):
            ((texture(u) - 0.5) ** 2).mean().backward()
            texture.step(0.01, eps=1e-3)

    whole = HashGridTexture(SMALL, seed=1, backend=first)
    train(whole, 2)
    resumed = HashGridTexture(SMALL, seed=99, backend=second)
    resumed(u).sum().backward()
    resumed.load_state(whole.state())
    assert_same_state(resumed.state(), whole.state())
    train(whole, 2)
    train(resumed, 2)
    if first == second:
        assert_same_state(resumed.state(), whole.state())
    torch.testing.assert_close(resumed.evaluate(u), whole.evaluate(u), atol=1e-5, rtol=1e-4)
    with pytest.raises(InputError, match="table"):
        HashGridTexture(replace(SMALL, levels=2)).load_state(whole.state())


def test_fits_a_function():
    texture = HashGridTexture(HashGridOptions(levels=6, log2_entries=12, base_resolution=8, growth=1.5, hidden=16, outputs=3))
    u = points(4000).clamp(0, 1)
    target = torch.stack([torch.sin(6 * u[:, 0]), u[:, 1] * u[:, 2], (u[:, 0] > 0.5).float()], 1)
    losses = []
    for _ in range(100):
        loss = ((texture(u) - target) ** 2).mean()
        losses.append(loss.item())
        loss.backward()
        texture.step(0.01)
    assert losses[-1] < losses[0] / 10
    assert ((texture.evaluate(u) - target) ** 2).mean() < losses[0] / 10


def test_import_is_light():
    code = "import sys, iif_core.fusion.hashgrid; print([m for m in ('torch', 'numba') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
