"""Metrics of flow: cases by hand."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from dase.tasks import flow_metrics as metrics


def test_errors_over_the_pixels_that_count():
    truth = torch.zeros(1, 2, 2, 2)
    truth[0, :, 0, 0] = torch.tensor([3.0, 4.0])
    truth[0, :, 1, 1] = float("nan")
    flow = torch.zeros(1, 2, 2, 2)
    flow[0, 0, 0, 1] = 1.0
    flow[0, 0, 1, 0] = 100.0
    mask = torch.tensor([[[True, True], [False, True]]])
    found = metrics.flow_errors(flow, truth, mask)
    assert float(found["aee"]) == pytest.approx((5 + 1) / 2)
    assert float(found["outliers"]) == pytest.approx(0.5)
    assert float(found["aee_zero"]) == pytest.approx(2.5)
    assert metrics.flow_errors(flow, truth, torch.zeros_like(mask))["aee"].isnan()


def test_warped_events_by_hand():
    events = tuple(torch.tensor(a) for a in ([1, 2], [1, 0], [0.5, 0.0], [True, False]))
    flow = torch.zeros(2, 3, 4)
    flow[0], flow[1] = 3.0, 1.0
    image = metrics.image_of_warped_events(events, flow, signed=True)
    want = torch.zeros(3, 4)
    want[1, 2] = want[1, 3] = want[2, 2] = want[2, 3] = 0.25  # (1 + 1.5, 1 + 0.5)
    want[0, 2] = -1
    assert torch.equal(image, want)
    assert metrics.image_of_warped_events(events, flow, signed=False).sum() == 2
    assert metrics.image_of_warped_events(events, 10 * flow, signed=False).sum() == 1


@pytest.mark.parametrize("signed", [True, False])
def test_true_flow_is_best(rng, signed):
    """Events of points that move by 8.3 and 4.1 px in the window."""
    count, size = 60, 64
    x0, y0 = (torch.from_numpy(rng.uniform(14, 40, (count, 1))) for _ in range(2))
    share = torch.from_numpy(rng.uniform(0, 1, (count, 40)))
    x, y = x0 + 8.3 * share, y0 + 4.1 * share
    polarity = (torch.arange(count) % 2 == 0)[:, None].expand(count, 40)
    events = tuple(a.reshape(-1) for a in (x.round().long(), y.round().long(), 1 - share, polarity))
    flow = torch.tensor([8.3, 4.1]).view(2, 1, 1).expand(2, size, size)
    values = {k: float(metrics.flow_warp_loss(events, k * flow, signed=signed)) for k in (-1, 0, 0.5, 1, 2)}
    assert values[0] == 1
    assert max(values, key=values.get) == 1
    assert values[1] > 1.3
    assert values[0.5] > 1  # which the blur is for
