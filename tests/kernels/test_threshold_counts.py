"""Counting of stored samples: exact in value, and surrogate gradients equal to their definitions."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the bridge needs torch")

from reference import threshold_counts as reference

from dase.kernels.autograd_counts import FLOOR, clipped_thresholds, count_events

GRID = 2.0**-12
"""Step of the dyadic grid [log intensity], on which float32 rounds nothing here."""

SURROGATES = ("interval", "events", "expected")


def tensor(array, device, *, grad=False):
    return torch.tensor(np.asarray(array), dtype=torch.float32, device=device, requires_grad=grad)


def signals(kind, rng, samples=60, pixels=300):
    """Return samples of one kind, shape (K, N) float32 [log intensity]."""
    t = np.linspace(0, 1, samples)[:, None]
    slope = rng.normal(0, 3, pixels)
    log = {
        "walk": lambda: np.cumsum(rng.normal(0, 0.15, (samples, pixels)), 0),
        "ramp": lambda: slope * t - 4,
        "crossing": lambda: slope * (t - 0.5),
        "wave": lambda: slope * np.sin(20 * t + slope),
        "constant": lambda: np.broadcast_to(slope, (samples, pixels)),
        "jump": lambda: np.where(t > 0.5, 10 * slope, 0) + rng.normal(0, 0.1, (samples, pixels)),
    }[kind]()
    return log.astype(np.float32)


def interval_counts(log, on, off, device, phase=None):
    """Return counts of every interval, shape (K - 1, 2, N), of samples (K, N) at direct thresholds."""
    theta = np.stack([off, on])[None]
    phase = None if phase is None else tensor(phase[None], device)
    got = count_events(
        tensor(log[None], device), tensor(theta, device), 0.0, 0.0, phase=phase, windows=range(len(log) - 1)
    )
    return got[0].cpu().numpy()


def walk_on_grid(rng, samples=50, pixels=200):
    return np.cumsum(rng.integers(-900, 901, (samples, pixels)), 0)


def thresholds_on_grid(rng, pixels=200):
    return rng.integers(300, 2000, (2, pixels))


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("kind", ["walk", "ramp", "crossing", "wave", "constant", "jump"])
def test_counts_equal_the_recursion_bit_for_bit(kind, equal, device, rng):
    log = signals(kind, rng)
    on, off = rng.uniform(0.02, 0.5, (2, log.shape[1])).astype(np.float32)
    off = on if equal else off
    fraction = rng.uniform(-1, 1, log.shape[1]).astype(np.float32)
    for phase in (np.zeros_like(fraction), fraction):
        want = reference.recursion(log, on, off, phase * np.where(phase >= 0, on, off))
        np.testing.assert_array_equal(interval_counts(log, on, off, device, phase), want)


@pytest.mark.parametrize("pixels", [300, 301, 302, 3])
def test_rows_of_any_length_and_up_to_a_million_events_at_once(pixels, device, rng):
    """A GPU asks for four pixels at once where the lengths of the rows allow."""
    log = rng.uniform(-5000, 5000, (12, pixels)).astype(np.float32)
    on, off = np.geomspace(0.011, 1, 2 * pixels).reshape(2, pixels).astype(np.float32)
    want = reference.recursion(log, on, off, np.zeros(pixels, np.float32))
    assert want.max() > 1e5
    np.testing.assert_array_equal(interval_counts(log, on, off, device), want)


def test_jump_gives_many_events_at_once(device):
    log = np.array([[0.0], [5.0], [-1.0]], np.float32)
    got = interval_counts(log, np.array([0.25]), np.array([0.5]), device)
    np.testing.assert_array_equal(got[..., 0], [[0, 20], [12, 0]])


def test_counts_equal_the_exact_recursion_on_the_dyadic_grid(device, rng):
    log, (on, off) = walk_on_grid(rng), thresholds_on_grid(rng)
    got = interval_counts(log * GRID, on * GRID, off * GRID, device)
    for n, (a, b) in enumerate(zip(on.tolist(), off.tolist(), strict=True)):
        np.testing.assert_array_equal(got[..., n], reference.exact(log[:, n].tolist(), a, b))


def test_clamped_level_is_exact_for_equal_thresholds(device, rng):
    log, (on, _) = walk_on_grid(rng), thresholds_on_grid(rng)
    got = interval_counts(log * GRID, on * GRID, on * GRID, device)
    for n, theta in enumerate(on.tolist()):
        np.testing.assert_array_equal(got[..., n], reference.clamp(log[:, n].tolist(), theta))


def test_equation_8_as_printed_is_wrong_in_some_intervals(device, rng):
    theta = 1 << 12
    log = np.cumsum(np.rint(rng.normal(0, 0.3 * theta, (200, 1000))).astype(int), 0)
    level = np.full(1000, 1.0)
    got = interval_counts(log / theta, level, level, device)
    exact = got[:, 1] - got[:, 0]
    wrong = {cut: np.mean(reference.printed(log, theta, truncate=cut) != exact) for cut in (True, False)}
    assert 0.01 < wrong[True] < 0.02  # floor read as truncation
    assert 0.03 < wrong[False] < 0.05  # floor as printed


def test_swapping_polarity_swaps_counts(device, rng):
    log = signals("walk", rng)
    on, off, phase = rng.uniform(0.02, 0.5, (3, log.shape[1])).astype(np.float32)
    got = interval_counts(-log, off, on, device, -phase)
    np.testing.assert_array_equal(got[:, ::-1], interval_counts(log, on, off, device, phase))


def test_a_constant_changes_nothing(device, rng):
    log, (on, off) = walk_on_grid(rng), thresholds_on_grid(rng)
    moved = log + rng.integers(-20000, 20000, log.shape[1])
    got = interval_counts(moved * GRID, on * GRID, off * GRID, device)
    np.testing.assert_array_equal(got, interval_counts(log * GRID, on * GRID, off * GRID, device))


def test_splitting_an_interval_changes_no_window(device, rng):
    log, (on, off) = 8 * walk_on_grid(rng), 8 * thresholds_on_grid(rng)
    eighths = rng.integers(0, 9, (len(log) - 1, log.shape[1]))
    between = log[:-1] + (log[1:] - log[:-1]) // 8 * eighths
    split = np.empty((2 * len(log) - 1, log.shape[1]), int)
    split[::2], split[1::2] = log, between
    theta = tensor(np.stack([off, on])[None] * GRID / 8, device)
    whole = count_events(tensor(log[None] * GRID / 8, device), theta, 0.0, 0.0, windows=range(len(log) - 1))
    windows = torch.arange(len(log) - 1).repeat_interleave(2)
    parts = count_events(tensor(split[None] * GRID / 8, device), theta, 0.0, 0.0, windows=windows)
    torch.testing.assert_close(parts, whole, rtol=0, atol=0)


@pytest.mark.parametrize("windows", [None, [0] * 6 + [2] * 6 + [0] * 7, [0] * 9 + [1] * 10])
def test_windows_sum_intervals(windows, device, rng):
    log = tensor(rng.normal(0, 0.5, (3, 20, 4, 5)).cumsum(1), device)
    mu = tensor(rng.uniform(0.1, 0.3, (3, 4, 5)), device)
    windows = windows or rng.integers(0, 4, 19).tolist()
    every = count_events(log, mu, 0.0, 0.0, windows=range(19))
    got = count_events(log, mu, 0.0, 0.0, windows=windows)
    assert got.shape == (3, max(windows) + 1, 2, 4, 5)
    assert got.sum() > 100
    for b in range(3):
        np.testing.assert_array_equal(got[b].cpu(), reference.binned(every[b].cpu().numpy(), windows))
    torch.testing.assert_close(count_events(log, mu, 0.0, 0.0)[:, 0], every.sum(1), rtol=0, atol=0)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("name", SURROGATES)
def test_gradients_equal_the_twin(name, shared, device, rng):
    log = tensor(rng.normal(0, 0.2, (2, 30, 150)).cumsum(1), device)
    mu = tensor(rng.uniform(0.15, 0.4, (2, 150) if shared else (2, 2, 150)), device, grad=True)
    sigma = tensor(rng.uniform(0.01, 0.04, mu.shape), device, grad=True)
    z = tensor(rng.normal(size=(2, 150) if shared else (2, 2, 150)), device)
    phase = tensor(rng.uniform(-1, 1, (2, 150)), device)
    windows = rng.integers(0, 3, 29).tolist()
    got = count_events(log, mu, sigma, z, phase=phase, windows=windows, surrogate=name, step=0.2)

    theta = (mu + sigma * z).reshape(2, -1, 150).expand(2, 2, 150)
    start = phase * torch.where(phase >= 0, theta[:, 1], theta[:, 0]).detach()
    if shared and name == "expected":  # both thresholds move together: not the sum of their single effects
        want = shared_expected(log, theta[:, 0], phase, windows, 0.2)
    else:
        want = reference.surrogate(log, theta, start, windows, name, 0.2)
    torch.testing.assert_close(got, want.detach(), rtol=0, atol=0)
    weight = torch.randn_like(got)
    for g, w in zip(
        torch.autograd.grad((got * weight).sum(), (mu, sigma)),
        torch.autograd.grad((want * weight).sum(), (mu, sigma)),
        strict=True,
    ):
        assert w.abs().max() > 1
        torch.testing.assert_close(g, w, rtol=1e-4, atol=1e-3)


def shared_expected(log, theta, phase, windows, step):
    """Return counts with the `expected` derivative by one threshold for both polarities."""

    def at(factor):
        moved = (theta.detach() * factor)[:, None].expand(-1, 2, -1)
        return reference.surrogate(log, moved, phase * moved[:, 0], windows, "events", step)

    slope = (at(np.float32(np.exp(step))) - at(np.float32(np.exp(-step)))) / (2 * np.sinh(step))
    return at(1.0) + slope * ((theta / theta.detach()) - 1)[:, None, None]


def wave_in_many_seeds(rng, device, seeds, samples):
    """Return waves, shape (seeds, K, 40), with one noise and phase for every seed and pixel."""
    t = np.linspace(0, 1, samples)[:, None]
    log = rng.uniform(0.2, 0.8, 40) * np.sin(9 * t + rng.uniform(0, 6, 40))
    # stratified: the same accuracy from far fewer seeds
    order = np.stack([rng.permutation(seeds) for _ in range(40)], 1)
    u = (order + rng.uniform(size=order.shape)) / seeds
    z = torch.special.ndtri(tensor(u, device).clamp(1e-6, 1 - 1e-6))
    phase = tensor(2 * rng.uniform(size=order.shape) - 1, device)
    return tensor(log[None], device).repeat(seeds, 1, 1), z, phase


@pytest.mark.parametrize("samples", [12, 100])
def test_expected_is_the_gradient_of_the_mean_count(samples, device, rng):
    log, z, phase = wave_in_many_seeds(rng, device, 4000, samples)
    mu = torch.full_like(z, 0.2, requires_grad=True)
    sigma = torch.full_like(z, 0.05, requires_grad=True)

    def total(m, s, name="expected"):
        return count_events(log, m, s, z, phase=phase, surrogate=name).sum() / len(z)

    def slope(name):
        return [g.sum().item() for g in torch.autograd.grad(total(mu, sigma, name), (mu, sigma))]

    with torch.no_grad():
        by_mu = (total(mu + 0.01, sigma) - total(mu - 0.01, sigma)).item() / 0.02
        by_sigma = (total(mu, sigma + 0.01) - total(mu, sigma - 0.01)).item() / 0.02
    got = slope("expected")
    assert got[0] == pytest.approx(by_mu, rel=0.03)
    assert got[1] == pytest.approx(by_sigma, rel=0.1)
    # the tolerance separates: the paper's surrogate depends on how finely time is sampled
    assert slope("interval")[0] != pytest.approx(by_mu, rel=0.03)


def test_gradient_leads_a_mean_back_over_the_floor(device):
    log = tensor(np.linspace(0, 1, 10)[None, :, None], device)

    def slope(mean, z, sign):
        mu = tensor([[mean]], device, grad=True)
        counts = count_events(log, mu, 0.1, tensor([[z]], device), surrogate="events")
        assert counts.sum().item() == pytest.approx(1 / FLOOR, abs=1)
        (gradient,) = torch.autograd.grad(sign * counts.sum(), mu)
        return gradient.item()

    assert slope(-0.05, 0.0, 1) < -1000  # descent raises the threshold
    assert slope(-0.05, 0.0, -1) == 0
    assert slope(0.2, -4.0, 1) == 0  # a rare sample of a healthy pixel: the gradient of the maximum


def test_mixed_polarity_axes(device, rng):
    log = tensor(rng.normal(0, 0.3, (2, 10, 7)).cumsum(1), device)
    mu = tensor(np.full((2, 7), 0.2), device, grad=True)
    z = tensor(rng.normal(size=(2, 2, 7)), device)
    assert clipped_thresholds(mu, 0.05, z, like=log).shape == (2, 2, 7)
    for name in SURROGATES:
        counts = count_events(log, mu, 0.05, z, surrogate=name)
        (g,) = torch.autograd.grad(counts.sum(), mu)
        assert g.shape == mu.shape


def test_no_grad_autocast_and_strides(device, rng):
    log = tensor(rng.normal(0, 0.3, (2, 16, 6, 8)).cumsum(1), device)
    mu, sigma = tensor(np.full((2, 6, 8), 0.2), device, grad=True), 0.05
    z = tensor(rng.normal(size=(2, 6, 8)), device)
    want = count_events(log, mu, sigma, z)
    (slope,) = torch.autograd.grad(want.square().sum(), mu)
    with torch.no_grad():
        quiet = count_events(log, mu, sigma, z, windows=[0] * 15)
    assert not quiet.requires_grad
    torch.testing.assert_close(quiet, want.detach(), rtol=0, atol=0)
    with torch.inference_mode():
        count_events(log, mu, sigma, z, windows=[0] * 7 + [1] * 8)
    # the windows cached above still serve a backward pass
    count_events(log, mu, sigma, z, windows=[0] * 7 + [1] * 8).sum().backward()

    strided = log.permute(3, 2, 1, 0).contiguous().permute(3, 2, 1, 0)
    assert not strided.is_contiguous()
    got = count_events(strided, mu.mT.contiguous().mT, sigma, z)
    torch.testing.assert_close(got, want, rtol=0, atol=0)
    with torch.autocast(torch.device(device).type, torch.bfloat16):
        got = count_events(log, mu, sigma, z)
        assert got.dtype == torch.float32
        loss = got.square().sum()
    torch.testing.assert_close(torch.autograd.grad(loss, mu)[0], slope)
    low = mu.detach().bfloat16().requires_grad_()
    (g,) = torch.autograd.grad(count_events(log, low, sigma, z).sum(), low)
    assert g.dtype == torch.bfloat16


def test_one_scene_without_pixels_has_no_counts(device):
    assert count_events(
        torch.zeros(1, 2, 0, device=device), torch.ones(1, 0, device=device), 0.0, 0.0
    ).shape == (
        1,
        1,
        2,
        0,
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log": torch.zeros(2, 5)}, r"log must have shape"),
        ({"log": torch.zeros(2, 1, 3)}, r"K >= 2"),
        ({"log": torch.zeros(2, 5, 3, dtype=torch.int32)}, r"log must be floating point"),
        ({"log": np.zeros((2, 5, 3))}, r"log must be a torch\.Tensor, got ndarray"),
        ({"mu": torch.zeros(2, 4)}, r"mu must have shape \(2, 3\) or \(2, 2, 3\), got \(2, 4\)"),
        ({"mu": 0.2}, r"mu must be a torch\.Tensor"),
        ({"sigma": torch.zeros(3, 3)}, r"sigma must have shape"),
        ({"z": torch.zeros(2, 3, device="meta")}, r"z must be on cpu"),
        ({"phase": torch.zeros(2, 2, 3)}, r"phase must have shape \(2, 3\)"),
        ({"windows": [0, 1]}, r"one window per interval, 4, got 2"),
        ({"windows": [0, 0, 0, -1]}, r"windows must be >= 0, got -1"),
        ({"windows": torch.zeros(4)}, r"1-D integers"),
        ({"surrogate": "floor"}, r"surrogate must be one of interval, events, expected, got 'floor'"),
        ({"step": 0.0}, r"step must be > 0"),
    ],
)
def test_bad_input_is_refused(change, message):
    given = {"log": torch.zeros(2, 5, 3), "mu": torch.ones(2, 3), "sigma": 0.0, "z": 0.0} | change
    with pytest.raises(ValueError, match=message):
        count_events(given.pop("log"), given.pop("mu"), given.pop("sigma"), given.pop("z"), **given)
