"""Metrics of pictures beside scikit-image, closed forms and cases by hand."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import structural_similarity as reference_ssim
from skimage.transform import downscale_local_mean

torch = pytest.importorskip("torch")

from dase.errors import InputError
from dase.tasks import image_metrics as metrics


@pytest.fixture
def pictures(rng):
    """Return two smooth pictures each of what was made and what is real, (2, 1, 180, 190)."""
    y, x = np.mgrid[:180, :190]
    real = 0.5 + 0.3 * np.sin(x / 9) * np.cos(y / 13) + 0.05 * rng.standard_normal((2, 180, 190))
    made = 0.8 * real + 0.1 + 0.05 * rng.standard_normal(real.shape)
    return tuple(torch.from_numpy(one).float()[:, None] for one in (made, real))


def test_ssim_is_that_of_scikit_image(pictures):
    made, real = pictures
    got = metrics.structural_similarity(made, real)
    for k in range(2):
        # its mean over all but a border of 5 px, where the window fits
        _, full = reference_ssim(
            made[k, 0].double().numpy(), real[k, 0].double().numpy(), gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, data_range=1.0, full=True,
        )  # fmt: skip
        assert float(got[k]) == pytest.approx(full[5:-5, 5:-5].mean(), abs=2e-5)
    assert torch.allclose(metrics.structural_similarity(real, real), torch.ones(2))


def test_ms_ssim_is_a_product_over_scales(pictures):
    made, real = pictures
    want = 1.0
    a, b = (one[0, 0].double().numpy() for one in pictures)
    for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        options = dict(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True)
        whole = reference_ssim(a, b, data_range=1.0, **options)[1][5:-5, 5:-5]
        if scale < 4:
            from scipy.ndimage import gaussian_filter

            mean = [gaussian_filter(one, 1.5, truncate=3.5)[5:-5, 5:-5] for one in (a, b)]
            whole = whole * (mean[0] ** 2 + mean[1] ** 2 + 1e-4) / (2 * mean[0] * mean[1] + 1e-4)
            size = a.shape[0] // 2 * 2, a.shape[1] // 2 * 2
        want *= whole.mean() ** weight
        a, b = (downscale_local_mean(one[: size[0], : size[1]], (2, 2)) for one in (a, b))
    assert float(metrics.multiscale_similarity(made, real)[0]) == pytest.approx(want, abs=1e-4)
    with pytest.raises(InputError, match="11x11"):
        metrics.multiscale_similarity(made[..., :100], real[..., :100])


def test_affine_match_is_least_squares(pictures):
    made, real = pictures
    got = metrics.affine_matched(made, real)
    for k in range(2):
        a = np.stack([made[k].flatten().numpy(), np.ones(made[k].numel())], 1).astype(np.float64)
        best = np.linalg.lstsq(a, real[k].flatten().numpy().astype(np.float64), rcond=None)[0]
        assert np.allclose(got[k].flatten().numpy(), a @ best, atol=1e-4)
    flat = metrics.affine_matched(torch.zeros(1, 1, 2, 2), torch.tensor([[[[0.0, 1.0], [1.0, 0.0]]]]))
    assert torch.equal(flat, torch.full((1, 1, 2, 2), 0.5))


def test_histogram_match_by_hand():
    made = torch.tensor([[[[5.0, -1.0], [2.0, 3.0]]]])
    real = torch.tensor([[[[0.1, 0.9], [0.4, 0.2]]]])
    want = torch.tensor([[[[0.9, 0.1], [0.2, 0.4]]]])
    assert torch.equal(metrics.histogram_matched(made, real), want)
    assert metrics.mean_squared_error(want, real).item() == pytest.approx((0.64 + 0.64 + 0.04 + 0.04) / 4)


def test_warping_moves_what_was_left_to_the_right(rng):
    before = torch.from_numpy(rng.random((1, 1, 6, 8))).float()
    flow = torch.zeros(1, 2, 6, 8)
    flow[:, 0], flow[:, 1] = 2, 1
    moved = metrics.warped(before, flow)
    assert torch.allclose(moved[..., 1:, 2:], before[..., :-1, :-2], atol=1e-6)
    assert torch.allclose(moved[..., 0, :], torch.zeros(8), atol=1e-6)


def test_temporal_inconsistency_by_hand():
    """One grey that grows by 0.2 while the real one grows by 0.1."""
    grey = torch.full((1, 1, 4, 4), 0.5)
    flow = torch.zeros(1, 2, 4, 4)
    got = metrics.temporal_inconsistency(grey + 0.2, grey, grey + 0.1, grey, flow)
    assert got.item() == pytest.approx(np.exp(-50 * 0.01) * 0.2, rel=1e-5)
    # what moves as the flow says costs nothing
    ramp = torch.arange(8.0).view(1, 1, 1, 8).expand(1, 1, 8, 8) / 8
    flow = torch.zeros(1, 2, 8, 8)
    flow[:, 0] = 1
    after = ramp - 1 / 8
    inside = metrics.temporal_inconsistency(
        after[..., 1:], ramp[..., 1:], after[..., 1:], ramp[..., 1:], flow[..., 1:]
    )
    assert inside.item() == pytest.approx(0, abs=2e-2)


def test_lpips_of_random_weights_is_its_formula(tmp_path, rng):
    """Against NumPy with one filter that is not 0 in each layer; no weights come with dase."""
    shapes = ((2, 3, 11, 11), (2, 2, 5, 5), (2, 2, 3, 3), (2, 2, 3, 3), (2, 2, 3, 3))
    arrays = {f"w{n}": 0.3 * rng.standard_normal(s).astype(np.float32) for n, s in enumerate(shapes)}
    arrays |= {f"b{n}": np.full(2, 0.5, np.float32) for n in range(5)}
    arrays |= {f"l{n}": np.array([0.25, 0.75], np.float32) for n in range(5)}
    np.savez(tmp_path / "alex.npz", **arrays)
    net = metrics.Lpips(tmp_path / "alex.npz")
    a, b = (torch.from_numpy(rng.random((1, 1, 64, 64))).float() for _ in range(2))
    want = 0.0
    for x, y in zip(net.features(a), net.features(b), strict=True):
        x, y = (one[0].numpy() / np.sqrt((one[0].numpy() ** 2).sum(0) + 1e-10) for one in (x, y))
        want += (np.array([0.25, 0.75])[:, None, None] * (x - y) ** 2).sum(0).mean()
    assert float(net(a, b)) == pytest.approx(want, rel=1e-4)
    assert float(net(a, a)) == 0
    weight, bias = (torch.from_numpy(arrays[name]) for name in ("w0", "b0"))
    first = torch.nn.functional.conv2d((2 * a - 1 - net.shift) / net.scale, weight, bias, 4, 2).relu()
    assert torch.equal(net.features(a)[0], first)
    np.savez(tmp_path / "few.npz", w0=arrays["w0"])
    with pytest.raises(InputError, match="holds no weights of LPIPS"):
        metrics.Lpips(tmp_path / "few.npz")
