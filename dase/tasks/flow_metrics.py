"""How good optical flow is: beside the true one, and where there is none by how sharp it makes the events."""

from __future__ import annotations

import torch
import torch.nn.functional as F


def endpoint_errors(flow: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the distance of flow from the true one, both (N, 2, H, W), of shape (N, H, W), in their unit."""
    return (flow - truth).square().sum(1).sqrt()


def flow_errors(
    flow: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor, *, outlier: float = 3.0
) -> dict[str, torch.Tensor]:
    """Return the mean endpoint error and the share of outliers over some pixels of all pictures.

    Pixels whose true flow is not finite are left out.

    Args:
        flow: Displacements [px], shape (N, 2, H, W).
        truth: True ones [px], shape (N, 2, H, W).
        mask: Pixels that count, as those with events, bool, shape (N, H, W).
        outlier: Endpoint error above which a pixel is one [px].

    Returns:
        `aee` [px], `outliers` (share above that) and `aee_zero` [px], the error of no flow at all; scalars,
        not a number where no pixel counts.
    """
    counted = mask & truth.isfinite().all(1)
    errors = endpoint_errors(flow, truth)[counted]
    still = endpoint_errors(torch.zeros_like(truth), truth)[counted]
    return {"aee": errors.mean(), "outliers": (errors > outlier).float().mean(), "aee_zero": still.mean()}


def image_of_warped_events(
    events: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], flow: torch.Tensor, *, signed: bool
) -> torch.Tensor:
    """Return the image of events that the flow carries to the end of their window, bilinear.

    Args:
        events: Column, row, part of the window that is left in [0, 1], polarity (true is ON), each (N,).
        flow: Displacement in the whole window, x and y [px], shape (2, H, W).
        signed: Whether OFF events count negative.

    Returns:
        Shape (H, W); what leaves the image is lost.
    """
    x, y, left, polarity = events
    height, width = flow.shape[1:]
    moved = flow[:, y.long(), x.long()] * left.float()
    u, v = x.float() + moved[0], y.float() + moved[1]
    sign = torch.where(polarity.bool(), 1.0, -1.0) if signed else torch.ones_like(u)
    image = torch.zeros(height * width, device=flow.device)
    for right in (0, 1):
        for below in (0, 1):
            column, row = u.floor() + right, v.floor() + below
            weight = (1 - (u - column).abs()) * (1 - (v - row).abs()) * sign
            inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
            image.index_add_(0, (row * width + column)[inside].long(), weight[inside])
    return image.view(height, width)


def flow_warp_loss(
    events: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], flow: torch.Tensor, *,
    signed: bool = False,
) -> torch.Tensor:  # fmt: skip
    """Return FWL: the variance of the image of warped events over that of the unwarped one, a scalar.

    Above 1 is better than no flow. Interpolation alone lowers the variance of what moves by parts of a pixel
    (half of a true flow would score below 1), so both images are blurred by 1 px, which both lose alike; this
    differs from Stoffregen et al. (2020), who do not blur. Windows of 1/30 s at least tell something.

    Args:
        events: Column, row, part of the window that is left in [0, 1], polarity (true is ON), each (N,).
        flow: Displacement in the whole window, x and y [px], shape (2, H, W).
        signed: Whether OFF events count negative, as Stoffregen et al. have it.
    """
    moved, still = (
        blurred(image_of_warped_events(events, one, signed=signed)) for one in (flow, torch.zeros_like(flow))
    )
    return moved.var() / still.var()


def blurred(image: torch.Tensor) -> torch.Tensor:
    """Return an image (H, W) blurred by a Gaussian of 1 px, zeros around it."""
    x = torch.arange(-3.0, 4.0, device=image.device)
    weights = torch.exp(-0.5 * x**2)
    weights = weights / weights.sum()
    rows = F.conv2d(image[None, None], weights.view(1, 1, 1, -1), padding=(0, 3))
    return F.conv2d(rows, weights.view(1, 1, -1, 1), padding=(3, 0))[0, 0]
