"""How far reconstructed pictures are from the true ones: metrics that are losses, too.

All take pictures (N, 1, H, W), which are meant to lie in [0, 1], and return one number of each, (N,).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from dase.errors import InputError
from dase.files.text_files import stands_for

SSIM_SIGMA = 1.5
"""Of the Gaussian window [px], which reaches 5 px to each side; Wang et al., 2004."""
SSIM_SIDE = 11
"""Side of the Gaussian window [px]."""
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the scales of MS-SSIM from fine to coarse; Wang et al., 2003."""


def mean_squared_error(made: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
    """Return the mean squared difference of pictures (N, 1, H, W), shape (N,)."""
    return (made - real).square().mean((1, 2, 3))


def affine_matched(made: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
    """Return pictures (N, 1, H, W) with the gain and offset that bring each nearest to the real one.

    A picture of one grey becomes the mean of the real one.
    """
    x, y = made.flatten(1), real.flatten(1)
    x_mean, y_mean = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    spread = (x - x_mean).square().mean(1, keepdim=True)
    together = ((x - x_mean) * (y - y_mean)).mean(1, keepdim=True)
    gain = torch.where(spread > 0, together / spread.clamp_min(torch.finfo(x.dtype).tiny), 0)
    return (gain * (x - x_mean) + y_mean).view_as(real)


def histogram_matched(made: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
    """Return pictures (N, 1, H, W) with the real one's grey levels in the order of their own."""
    order = made.flatten(1).argsort(dim=1, stable=True).argsort(dim=1)
    return torch.gather(real.flatten(1).sort(1).values, 1, order).view_as(real)


def _gaussian(device: torch.device) -> torch.Tensor:
    x = torch.arange(SSIM_SIDE, dtype=torch.float32, device=device) - SSIM_SIDE // 2
    weights = torch.exp(-0.5 * (x / SSIM_SIGMA) ** 2)
    return weights / weights.sum()


def _ssim_parts(a: torch.Tensor, b: torch.Tensor, data_range: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return SSIM and its part without luminance, both (N,), over places where the window fits."""
    if min(a.shape[-2:]) < SSIM_SIDE:
        size = f"{a.shape[-1]}x{a.shape[-2]}"
        raise InputError(f"SSIM: pictures must have {SSIM_SIDE}x{SSIM_SIDE} pixels at least, got {size}")
    weights = _gaussian(a.device)

    def blur(image: torch.Tensor) -> torch.Tensor:
        return F.conv2d(F.conv2d(image, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))

    with torch.autocast(a.device.type, enabled=False):
        a, b = a.float(), b.float()
        a_mean, b_mean = blur(a), blur(b)
        a_variance, b_variance = blur(a * a) - a_mean**2, blur(b * b) - b_mean**2
        covariance = blur(a * b) - a_mean * b_mean
        c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
        contrast = (2 * covariance + c2) / (a_variance + b_variance + c2)
        luminance = (2 * a_mean * b_mean + c1) / (a_mean**2 + b_mean**2 + c1)
        return (luminance * contrast).mean((1, 2, 3)), contrast.mean((1, 2, 3))


def structural_similarity(made: torch.Tensor, real: torch.Tensor, *, data_range: float = 1.0) -> torch.Tensor:
    """Return SSIM of pictures (N, 1, H, W), shape (N,): Gaussian window of 1.5 px, biased variances.

    Source: Wang et al., Image quality assessment, 2004; equal to scikit-image's with `gaussian_weights`.
    """
    return _ssim_parts(made, real, data_range)[0]


def multiscale_similarity(made: torch.Tensor, real: torch.Tensor, *, data_range: float = 1.0) -> torch.Tensor:
    """Return MS-SSIM of pictures (N, 1, H, W) of five scales, 176x176 pixels at least, shape (N,).

    Negative contrasts of a scale count as 0. Source: Wang et al., Multiscale structural similarity, 2003.
    """
    out = torch.ones(len(made), device=made.device)
    last = len(SCALE_WEIGHTS) - 1
    for scale, weight in enumerate(SCALE_WEIGHTS):
        whole, contrast = _ssim_parts(made, real, data_range)
        out = out * (whole if scale == last else contrast).clamp_min(0) ** weight
        if scale < last:
            made, real = F.avg_pool2d(made, 2), F.avg_pool2d(real, 2)
    return out


def warped(pictures: torch.Tensor, displacement: torch.Tensor) -> torch.Tensor:
    """Return pictures, each pixel of which is looked up where its content was before.

    Args:
        pictures: The moment before, shape (N, C, H, W).
        displacement: Of what is seen at each pixel since then, x and y [px], shape (N, 2, H, W).

    Returns:
        Shape (N, C, H, W), bilinear; 0 outside of the picture.
    """
    height, width = pictures.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(height, device=pictures.device),
        torch.arange(width, device=pictures.device),
        indexing="ij",
    )
    u = (x - displacement[:, 0]) * (2 / max(width - 1, 1)) - 1
    v = (y - displacement[:, 1]) * (2 / max(height - 1, 1)) - 1
    return F.grid_sample(pictures, torch.stack([u, v], -1), align_corners=True)


def temporal_inconsistency(
    made: torch.Tensor, made_before: torch.Tensor, real: torch.Tensor, real_before: torch.Tensor,
    displacement: torch.Tensor, *, decay: float = 50.0,
) -> torch.Tensor:  # fmt: skip
    """Return by how much pictures change beyond the motion, shape (N,); S2R's temporal loss.

    The picture before is warped by the flow; pixels count by exp(-decay d²), d the same difference of the
    real pictures, so that what is covered or changes its light does not.

    Args:
        made: Pictures, shape (N, 1, H, W).
        made_before: Those of the window before, shape (N, 1, H, W).
        real: Labels, shape (N, 1, H, W).
        real_before: Labels of the window before, shape (N, 1, H, W).
        displacement: Motion since then, x and y [px], shape (N, 2, H, W).
        decay: Of the trust in a pixel with that difference; E2VID and S2R have 50.
    """
    trust = torch.exp(-decay * (real - warped(real_before, displacement)).square())
    return (trust * (made - warped(made_before, displacement)).abs()).mean((1, 2, 3))


class Lpips(torch.nn.Module):
    """Perceptual distance LPIPS 0.1 with the features of AlexNet (Zhang et al., 2018).

    dase has no weights of it and loads none: the user names a file.

    Args:
        path: NumPy archive of `w0` to `w4` and `b0` to `b4`, the five convolutions, and `l0` to `l4`, the
            linear layers.

    Raises:
        InputError: It does not hold them.
    """

    STRIDES = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))  # and paddings

    def __init__(self, path: str | Path):
        super().__init__()
        try:
            with Path(path).open("rb") as head:
                pointer = stands_for(head.read(1024))
            if pointer:
                raise ValueError(pointer)
            with np.load(path, allow_pickle=False) as file:
                arrays = {
                    f"{kind}{n}": file[f"{kind}{n}"].astype(np.float32) for kind in "wbl" for n in range(5)
                }
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{path}: holds no weights of LPIPS w0..w4, b0..b4, l0..l4: {error}") from error
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(array))
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))

    def features(self, pictures: torch.Tensor) -> list[torch.Tensor]:
        """Return the five layers' features, each (N, C, h, w), of pictures (N, 1, H, W) in [0, 1]."""
        x, out = ((2 * pictures - 1).expand(-1, 3, -1, -1) - self.shift) / self.scale, []
        for layer, (stride, padding) in enumerate(self.STRIDES):
            if layer in (1, 2):
                x = F.max_pool2d(x, 3, 2)
            x = F.relu(F.conv2d(x, getattr(self, f"w{layer}"), getattr(self, f"b{layer}"), stride, padding))
            out.append(x)
        return out

    def forward(self, made: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
        """Return the distance of pictures (N, 1, H, W) in [0, 1], shape (N,)."""
        total = torch.zeros(len(made), device=made.device)
        with torch.autocast(made.device.type, enabled=False):
            layers = zip(self.features(made.float()), self.features(real.float()), strict=True)
            for layer, (a, b) in enumerate(layers):
                a, b = (one / (one.square().sum(1, keepdim=True) + 1e-10).sqrt() for one in (a, b))
                weight = getattr(self, f"l{layer}").view(1, -1, 1, 1)
                total = total + ((a - b).square() * weight).sum(1).mean((1, 2))
        return total
