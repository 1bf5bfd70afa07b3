"""What a bank of critics needs of the kernels, on PyTorch's tensors; gradients are written out by hand."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import torch

from dase.kernels import critic_layers as _critics
from dase.kernels import critic_products as _bank
from dase.kernels import critic_rows as _rows
from dase.kernels.autograd_counts import launch_on_tensors


@dataclass
class RowLayout:
    """Rows of a step, critic by critic, each critic's in the order fake, real, half way between.

    Args:
        number: Rows of each class, fake and real, int32 (2, C).
        end: Where a critic's rows end among all, and among those half way, int32 (2, C).
        order: Which row lies where, numbered fake, real, half way; -1 behind the last; int32 (R,).
        of: Its critic, C behind the last, int32 (R,).
        gain: Derivative of the loss by its score, float32 (R,).
        place: Where the rows half way lie, -1 for pairs that there are not, int32 (N,).
        held: What they weigh in the penalty, float32 (N,).
        sides: Fake and real rows, N + M; greater numbers in `order` are half way.
    """

    number: torch.Tensor
    end: torch.Tensor
    order: torch.Tensor
    of: torch.Tensor
    gain: torch.Tensor
    place: torch.Tensor
    held: torch.Tensor
    sides: int


def sort_keys(keys: torch.Tensor, *, below: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return keys (N,) from 0 on in order, int32, and where each was; equal ones keep their order."""
    # a GPU's sort goes over all bits of a key
    ordered, order = torch.sort(keys.short() if below <= 2**15 else keys, stable=True)
    return ordered.int(), order


def lay_out_rows(fake: torch.Tensor, real: torch.Tensor, weights: torch.Tensor) -> RowLayout:
    """Lay out the rows of critics that have some of both sides.

    Args:
        fake: Class of each fake row, int64 (N,); the number of critics for none.
        real: The same of the real ones, int64 (M,).
        weights: Of each class, float32 (C,).
    """
    critics, sides, device = len(weights), len(fake) + len(real), weights.device
    number, size = (torch.empty(2, critics, dtype=torch.int32, device=device) for _ in range(2))
    keys, row = sort_keys(torch.cat([2 * fake, 2 * real + 1]), below=2 * critics + 2)
    launch_on_tensors(_rows.count_rows, [keys], [number, size], over=weights[None])
    end = size.cumsum(1, dtype=torch.int32)

    def preset(size: int, value: int) -> torch.Tensor:
        return torch.full((size,), value, dtype=torch.int32, device=device)

    whole = sides + len(fake)
    order, of, place = preset(whole, -1), preset(whole, critics), preset(len(fake), -1)
    gain, held = (torch.zeros(n, device=device) for n in (whole, len(fake)))
    outputs = [order, of, gain, place, held]
    launch_on_tensors(_rows.place_rows, [keys, row, number, end, weights], outputs, over=keys[None])
    return RowLayout(number, end, order, of, gain, place, held, sides)


def gather_rows(
    fake: torch.Tensor, real: torch.Tensor, share: torch.Tensor, layout: RowLayout, dtype: torch.dtype
) -> torch.Tensor:
    """Return all rows in order, (R, K) of `dtype`; `share` (N, 1) is that of the fake one half way."""
    rows = torch.empty(len(layout.order), fake.shape[1], dtype=dtype, device=fake.device)
    inputs = [fake, real, share, layout.order, layout.of, layout.number]
    launch_on_tensors(_layer_kernels(rows).gather, inputs, [_as_words(rows)], size=rows.shape[1] // 4)
    return rows


def count_steps(
    layout: RowLayout, rate: torch.Tensor, steps: torch.Tensor, *, decay: float, momentum: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Count a step of the critics that have rows in `steps` (C,); return their rates and corrections.

    Rates are those of `move_critics`: they make up for a mean that began at 0.
    """
    rates, correction = torch.empty_like(steps), torch.empty_like(steps)
    launch_on_tensors(
        _rows.count_steps,
        [layout.number, rate.view(1), decay, momentum],
        [steps, rates, correction],
        over=steps[None],
    )
    return rates, correction


def first_layer(
    product: torch.Tensor, of: torch.Tensor, bias: torch.Tensor, *, slope: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sums of the first layer, float32 (R, J), and what goes on, in the type of the product."""
    total, hidden = torch.empty_like(product, dtype=torch.float32), torch.empty_like(product)
    launch_on_tensors(_layer_kernels(product).first_layer, [product, of, bias, slope], [total, hidden])
    return total, hidden


def second_layer(
    product: torch.Tensor, of: torch.Tensor, bias: torch.Tensor, last: torch.Tensor, *, slope: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the sums of the second layer, the scores' derivative by them, both float32, and it again.

    `last` are the weights of the third layer, (C, J).
    """
    total, by_total = (torch.empty_like(product, dtype=torch.float32) for _ in range(2))
    back = torch.empty_like(product)
    launch_on_tensors(
        _layer_kernels(product).second_layer, [product, of, bias, last, slope], [total, by_total, back]
    )
    return total, by_total, back


def back_through_first_layer(
    product: torch.Tensor, of: torch.Tensor, total: torch.Tensor, *, critics: int, slope: float
) -> torch.Tensor:
    """Return the scores' derivative by the sums `total` of the first layer, float32 (R, J)."""
    out = torch.empty_like(total)
    launch_on_tensors(_layer_kernels(product).way_back, [product, of, total, slope, critics], [out])
    return out


def score_rows(
    second: torch.Tensor, of: torch.Tensor, last: torch.Tensor, bias: torch.Tensor, *, slope: float
) -> torch.Tensor:
    """Return the score of each row (R,) from the sums of the second layer; 0 for rows of no critic."""
    out = torch.empty(len(of), device=second.device)
    launch_on_tensors(_critics.score_rows, [second, of, last, bias, slope], [out], over=out[None])
    return out


def rows_half_way(values: torch.Tensor, layout: RowLayout, dtype: torch.dtype) -> torch.Tensor:
    """Return the rows half way of values of all rows, (N, J) of `dtype`."""
    out = torch.empty(len(layout.place), values.shape[1], dtype=dtype, device=values.device)
    launch_on_tensors(_layer_kernels(out).half_way, [values, layout.place], [out])
    return out


def penalise_gradient(gradient: torch.Tensor, layout: RowLayout, rows: torch.Tensor) -> torch.Tensor:
    """Return half the derivative of the mean square by the gradient (N, K), and set `rows` half way to it."""
    out = torch.empty_like(gradient)
    inputs = [_as_words(gradient), layout.place, layout.held]
    launch_on_tensors(
        _layer_kernels(gradient).penalise,
        inputs,
        [_as_words(out), _as_words(rows)],
        size=gradient.shape[1] // 4,
    )
    return out


def penalty_through_first_layer(
    product: torch.Tensor,
    total: torch.Tensor,
    by_total: torch.Tensor,
    layout: RowLayout,
    hidden: torch.Tensor,
    *,
    slope: float,
    penalty: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a product (N, J) times the slopes of the first layer, and set `hidden` half way to it.

    Also the terms of the mean squared gradient, float32 (N, J).
    """
    out, square = torch.empty_like(product), torch.empty_like(product, dtype=torch.float32)
    inputs = [product, total, by_total, layout.place, slope, penalty]
    launch_on_tensors(_layer_kernels(product).again_first, inputs, [out, hidden, square])
    return out, square


def penalty_through_second_layer(
    product: torch.Tensor, total: torch.Tensor, layout: RowLayout, last: torch.Tensor, *, slope: float
) -> None:
    """Set `last` half way to a product (N, J) times the slopes of the second layer."""
    launch_on_tensors(
        _layer_kernels(product).again_second, [total, layout.place, slope, product], [last], over=product
    )


def weigh_rows(
    second: torch.Tensor,
    by_first: torch.Tensor,
    by_second: torch.Tensor,
    layout: RowLayout,
    *,
    slope: float,
    penalty: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the left rows of both layers' gradients, and the terms of the third's but for rows half way.

    Args:
        second: Sums of the second layer, shape (R, J).
        by_first: Derivative of the scores by the first layer's sums, shape (R, J).
        by_second: Derivative of the scores by the second layer's sums, shape (R, J).
        layout: Where rows lie.
        slope: Of units below 0.
        penalty: Weight of the mean squared gradient half way.

    Returns:
        Three tensors of shape (R, J).
    """
    order, gain, between = layout.order, layout.gain, layout.sides
    left_first, left_second, last = (torch.empty_like(v) for v in (by_first, by_second, second))
    launch_on_tensors(_critics.weigh_first, [by_first, order, gain, between, penalty], [left_first])
    launch_on_tensors(
        _critics.weigh_second, [second, by_second, order, gain, between, slope], [left_second, last]
    )
    return left_first, left_second, last


def sum_rows(values: torch.Tensor, layout: RowLayout, *, between: bool) -> torch.Tensor:
    """Return the sum over each critic's rows, (C, J), with or without those half way."""
    out = torch.empty(layout.end.shape[1], values.shape[1], device=values.device)
    before = len(layout.order) if between else layout.sides
    launch_on_tensors(_rows.sum_rows, [values, layout.order, layout.end, before], [out])
    return out


def _as_words(rows: torch.Tensor) -> torch.Tensor:
    return rows.view(torch.int32)


def _layer_kernels(rows: torch.Tensor) -> SimpleNamespace:
    return _critics.layer_kernels[rows.dtype == torch.bfloat16]


def move_critics(
    weight: torch.Tensor,
    square: torch.Tensor,
    copy: torch.Tensor,
    left: torch.Tensor,
    right: torch.Tensor,
    end: torch.Tensor,
    rate: torch.Tensor,
    correction: torch.Tensor,
    *,
    decay: float,
    mean: torch.Tensor | None = None,
    momentum: float = 0.0,
    tiny: float = 1e-8,
) -> None:
    """Move weights along the sum of outer products of `left` and `right` rows, by Adam without momentum.

    With `mean` by AdaBelief (Zhuang et al., 2020): along the running mean, over the root of how far
    gradients stray from it.

    Args:
        weight: Changed in place, float32 (C, J, K); J and K are multiples of 4.
        square: Running mean of squared gradients, or of what they stray by squared, changed in place, shaped
            alike.
        copy: Set to the weights in bfloat16, (C, J, K).
        left: float32 (R, J), the rows of critic 0 first.
        right: bfloat16 or float32 (R, K), in the same order.
        end: Where the rows of each critic end, int32 (C,).
        rate: Learning rate of each critic, float32 (C,); those at 0 are not touched.
        correction: 1 / (1 - decay^steps) of each critic, float32 (C,).
        decay: Of `square`.
        mean: Running mean of gradients, changed in place, shaped as the weights; None for Adam.
        momentum: Decay of `mean`.
        tiny: Added to the root of the mean square, and to this itself by AdaBelief.
    """
    half = right.dtype == torch.bfloat16
    inputs = [left, _as_words(right), end, rate, correction, decay, momentum, tiny]
    known = square if mean is None else mean
    outputs = [*(one.flatten(0, 1) for one in (weight, square, known)), _as_words(copy).flatten(0, 1)]
    strips = -(-weight.shape[1] // (_bank.TILE * _bank.STRIP)) * weight.shape[2] // _bank.TILE
    launch_on_tensors(
        _bank.step_kernels[half, mean is not None], inputs, outputs, over=rate[:, None], size=strips
    )


def move_sums(
    weight: torch.Tensor,
    square: torch.Tensor,
    gradient: torch.Tensor,
    rate: torch.Tensor,
    correction: torch.Tensor,
    *,
    decay: float,
    mean: torch.Tensor | None = None,
    momentum: float = 0.0,
    tiny: float = 1e-8,
) -> None:
    """Move weights along a gradient, all float32 (C, J); see `move_critics`."""
    known = square if mean is None else mean
    launch_on_tensors(
        _bank.sum_kernels[mean is not None], [gradient, rate, correction, decay, momentum, tiny],
        [weight, square, known], over=gradient,
    )  # fmt: skip


def multiply_by_critic(rows: torch.Tensor, weights: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Multiply the few rows of each critic with its weights.

    Args:
        rows: bfloat16 (R, K), the rows of critic 0 first; K is a multiple of 4.
        weights: bfloat16 (C, K, N), contiguous; N is a multiple of 4.
        end: Where the rows of each critic end, int32 (C,).

    Returns:
        bfloat16 (R, N), anything in rows behind the last critic's.
    """
    out = torch.empty(len(rows), weights.shape[2], dtype=rows.dtype, device=rows.device)
    parts = torch.empty_like(end)
    launch_on_tensors(_bank.count_parts, [end], [parts], over=parts[None])
    most = len(rows) // _bank.ROWS + len(end)
    inputs = [_as_words(rows), _as_words(weights).flatten(0, 1), end, parts.cumsum(0, dtype=torch.int32)]
    each = end.new_empty(1).expand(most, weights.shape[2] // _bank.TILE)
    launch_on_tensors(_bank.multiply_parts, inputs, [_as_words(out)], over=each)
    return out
