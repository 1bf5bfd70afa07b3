"""Light that flickers: the whole array brightens and dims with one phase.

What moves in the scene has another phase in each stretch of time; a lamp keeps its own. Bursts that come with
a camera's frames are left out before the frequency is read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import uniform_filter1d

from dase.formatting import format_percent, format_seconds
from dase.signatures.chance import NINETY, mean_interval
from dase.signatures.clock import ClockCounts
from dase.signatures.frame_coupling import BurstClock
from dase.signatures.kinds import FLICKER
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class FlickerSettings:
    """How tones are looked for."""

    least: float = 0.02  # swing, share of the rate
    slowest: float = 20.0  # [Hz] one cycle in a block
    slowest_lamp: float = 45.0  # [Hz] mains have 50 or 60; frames, whose times are not known, have less
    fastest: float = 450.0  # [Hz]
    block: float = 0.05  # [s] longer than a lamp's cycles, shorter than what moves keeps its phase
    short: float = 1.5  # [s] recordings in which a lamp keeps its phase for too few of these to be told
    short_block: float = 0.025  # [s] which they are cut into then
    short_slowest: float = 80.0  # [Hz] two cycles in one of these
    short_tiles: float = 1e3  # times that tiles count as likelier to agree by chance there: nearly all must
    smooth: float = 0.03  # [s] over which the usual rate is taken
    segment: float = 16.0  # [s] the mains keep their phase no longer
    overtones: int = 3  # a lamp's light is no sine
    fewest_blocks: int = 9
    fewest_events: int = 2000
    tiles: int = 4  # on each side: what moves is larger than the tiles of the clock
    agree: float = 0.125  # turns by which a tile may differ from the others
    spacing: float = 0.25  # of tried frequencies, relative to what the length resolves
    periods: int = 6  # at most, of the tone, in one of what it may be an overtone of
    between: float = 0.25  # of the tone's amplitude, at a frequency between its multiples: no lamp's
    between_chance: float = 0.01  # that a lamp is taken for a longer period's by what is there by chance


@dataclass(frozen=True)
class Lamp:
    """The tone that was found.

    Args:
        frequency: [Hz].
    """

    frequency: float


@dataclass(frozen=True)
class _Rates:
    """What the events of all polarities do over time, free of bursts.

    Args:
        net: ON minus OFF events, beyond the usual balance, by step and tile, shape (K, T).
        usual: Usual events of all tiles, shape (K,).
        kept: Which steps are free of bursts, shape (K,).
        events: All events of these steps, shape (K, T).
    """

    net: NDArray[np.float64]
    usual: NDArray[np.float64]
    kept: NDArray[np.bool_]
    events: NDArray[np.float64]


def _merge_tiles(counts: NDArray[np.uint32], sides: int, wanted: int) -> NDArray[np.float64]:
    """Return counts (K, 2, T) of fewer, larger tiles."""
    part = sides // wanted
    square = counts.reshape(len(counts), 2, wanted, part, wanted, part)
    out: NDArray[np.float64] = square.sum((3, 5), dtype=np.float64).reshape(len(counts), 2, wanted**2)
    return out


def _net_rates(clock: ClockCounts, bursts: BurstClock | None, s: FlickerSettings) -> _Rates:
    counts = _merge_tiles(clock.counts, clock.settings.tiles, s.tiles)
    kept = np.ones(len(counts), np.bool_) if bursts is None else ~bursts.contains(clock.times)
    counts[~kept] = 0
    events = counts.sum(1)
    net = counts[:, 1] - counts[:, 0]
    window = round(s.smooth / clock.settings.step)
    share = np.maximum(uniform_filter1d(kept.astype(np.float64), window), 1e-9)
    usual = uniform_filter1d(events.sum(1), window) / share
    # what ticks in the time stamps alone moves ON and OFF events together, and leaves their balance
    balance = uniform_filter1d(net.sum(1), window) / share / np.maximum(usual, 1e-9)
    net = net - events * balance[:, None]
    return _Rates(net, usual, kept, events)


@dataclass(frozen=True)
class _Tones:
    """What the blocks of a segment have in common at frequencies from 0 on, `spacing` apart [Hz]."""

    rayleigh: NDArray[np.float64]  # of the phases of blocks
    power: NDArray[np.float64]  # of their sum
    spacing: float


def _sum_blocks(v: NDArray[np.float64], step: float, s: FlickerSettings) -> _Tones:
    """Return what the blocks of a signal, shape (K,), have in common.

    The phase of a block at its middle hardly depends on the exact frequency that it is read at, so one
    transform per block, and one over the blocks, stand for all frequencies.
    """
    length = round(s.block / step)
    blocks = len(v) // length
    v = v[: blocks * length].reshape(blocks, length)
    pad = 8 * length  # cells of 2.5 Hz
    spectrum = np.fft.rfft(v * np.hanning(length), pad)
    cell = 1 / (pad * step)
    middle = np.exp(2j * np.pi * np.arange(spectrum.shape[1]) * cell * (length - 1) / 2 * step)
    spectrum *= middle
    power = np.abs(spectrum)
    phases = np.where(power > 1e-12, spectrum / np.maximum(power, 1e-12), 0)
    filled = max(int(np.count_nonzero(power.max(1) > 1e-12)), 1)
    many = 1 << math.ceil(math.log2(max(blocks / s.spacing, 8)))
    spacing = 1 / (s.block * many)
    # over blocks 50 ms apart, frequencies repeat every 20 Hz: each cell takes those next to it
    # and a block's middle turns with the frequency
    frequencies = np.arange(int(0.45 / step / spacing)) * spacing
    nearest = np.rint(frequencies / cell).astype(np.int64)
    places = nearest, np.arange(len(frequencies)) % many
    cells = nearest[-1] + 1
    turning, turning_sum = (np.fft.fft(one[:, :cells].T, many)[places] for one in (phases, spectrum))
    return _Tones(np.abs(turning) ** 2 / filled, np.abs(turning_sum) ** 2, spacing)


def _find_tone(
    v: NDArray[np.float64], step: float, bursts: BurstClock | None, s: FlickerSettings
) -> tuple[float, float, int]:
    """Return the tone [Hz] that keeps its phase best, its p, and with how many overtones.

    Sums of Rayleigh statistics of independent phases are gamma distributed; as many tones are tried as there
    are independent ones, twice for those between, and with and without overtones.
    """
    length = round(s.block / step)
    segments = max(1, math.ceil(len(v) * step / s.segment))
    size = len(v) // segments // length * length
    parts = [_sum_blocks(v[i * size : (i + 1) * size], step, s) for i in range(segments)]
    spacing = parts[0].spacing
    rayleigh = np.sum([part.rayleigh for part in parts], axis=0)
    base = np.arange(math.ceil(s.slowest / spacing), int(s.fastest / spacing) + 1)
    lines = np.zeros(len(base), np.bool_)
    if bursts is not None:  # what is left of bursts has lines at multiples of the frame rate
        turns = base * spacing * bursts.interval
        lines = np.abs(turns - np.round(turns)) / bursts.interval < 0.75 / (size * step)
    best = base[:1], 1.0, 1
    tests = 2 * 2 * (s.fastest - s.slowest) * size * step
    for many in (1, s.overtones):
        total = np.zeros(len(base))
        tones = np.zeros(len(base), np.int64)
        for h in range(1, many + 1):
            inside = h * base < len(rayleigh)
            total[inside] += rayleigh[h * base[inside]]
            tones += inside
        total[lines] = 0.0
        p = stats.gamma.sf(total, segments * tones)
        chance = min(1.0, tests * float(p.min()))
        if chance <= best[1]:
            best = base[total >= 0.8 * total[p.argmin()]], chance, many
    # blocks 50 ms apart see a strong tone in step at every 20 Hz from it, and half a tone has its overtones:
    # of all that are clear, the strongest is meant, 20 Hz from those that chance has put first, too
    candidates, chance, many = best
    apart = round(1 / (s.block * spacing))
    tones = np.concatenate([h * candidates for h in range(1, many + 1)])
    tones = np.unique(np.concatenate([tones - apart, tones, tones + apart]))
    tones = tones[(tones >= base[0]) & (tones <= base[-1])]
    tones = tones[~lines[tones - base[0]]]
    power = np.sum([part.power for part in parts], axis=0)[tones]
    clear = rayleigh[tones] > 0.5 * rayleigh[tones].max()
    return float(tones[np.where(clear, power, -1.0).argmax()] * spacing), chance, many


def _find_tone_in_blocks(
    v: NDArray[np.float64], step: float, bursts: BurstClock | None, s: FlickerSettings, level: float
) -> tuple[float, float, int, FlickerSettings]:
    """Return what `_find_tone` does, and the settings by which it was found.

    A block tells no more than that its phase is the others'. A lamp that swings 0.1 of the rate in a clip of
    0.9 s has a chance of 4e-4 by 17 blocks, however clear it is in each, and one of 3e-15 by 35.
    """
    tone, p_tone, many = _find_tone(v, step, bursts, s)
    if p_tone < level or len(v) * step > s.short:
        return tone, p_tone, many, s
    finer = replace(s, block=s.short_block, slowest=s.short_slowest)
    other, chance, tones = _find_tone(v, step, bursts, finer)
    if 2 * chance < level:  # two ways to look
        return other, 2 * chance, tones, finer
    return tone, p_tone, many, s


def _longer_period(v: NDArray[np.float64], step: float, frequency: float, s: FlickerSettings) -> float:
    """Return the period of which a tone is an overtone [s], 0 where it is the tone's own.

    A lamp has multiples of its frequency and nothing between. Bursts of the array have all multiples of their
    rate, and where ON and OFF bursts take turns, any of them may be the strongest.
    """
    length = round(s.block / step)
    segments = max(1, math.ceil(len(v) * step / s.segment))
    size = len(v) // segments // length * length
    parts = [_sum_blocks(v[i * size : (i + 1) * size], step, s) for i in range(segments)]
    rayleigh = np.sum([part.rayleigh for part in parts], axis=0)
    power = np.sum([part.power for part in parts], axis=0)
    at = round(frequency / parts[0].spacing)
    near = 4 * s.spacing  # cells by which the tone may be off
    strongest = float(power[max(at - round(near / s.spacing), 0) : at + round(near / s.spacing) + 1].max())
    for many in range(2, s.periods + 1):
        lines = np.arange(1, int(many * s.fastest / frequency)) * (frequency / many)
        lines = lines[(lines >= s.slowest / 2) & (np.arange(1, len(lines) + 1) % many != 0)]
        # blocks see a strong tone in step at other frequencies as well
        apart = (lines - frequency) * s.block
        lines = lines[np.abs(apart - np.round(apart)) > 2 / max(size // length, 1)]
        cells = np.rint(lines / parts[0].spacing).astype(np.int64)
        if not len(cells):
            continue
        p = float(stats.gamma.sf(rayleigh[cells].sum(), segments * len(cells)))
        if p * s.periods < s.between_chance and power[cells].max() > s.between**2 * strongest:
            return many / frequency
    return 0.0


def _refine_tone(
    rates: _Rates, step: float, frequency: float, s: FlickerSettings
) -> tuple[float, float, NDArray[np.float64]]:
    """Return frequency [Hz], its standard error, and the swing of each block, from the phases of blocks."""
    length = round(s.block / step)
    blocks = len(rates.usual) // length
    rows = blocks * length
    net = rates.net[:rows].sum(1).reshape(blocks, length)
    count = rates.events[:rows].sum(1).reshape(blocks, length).sum(1)
    time = (np.arange(rows).reshape(blocks, length) + 0.5) * step
    middle = time.mean(1)
    size = max(1, round(s.segment / s.block))
    value, error = frequency, math.inf
    for _ in range(3):
        z = (net * np.exp(-2j * np.pi * value * time)).sum(1)
        slopes, weights = [], []
        for i in range(0, blocks, size):
            part, at = z[i : i + size], middle[i : i + size]
            if len(part) < s.fewest_blocks:
                continue
            turn = np.angle(part * np.conj(part.sum())) / (2 * np.pi)
            near = (np.abs(turn) < 0.25) & (count[i : i + size] > 0) & (np.abs(part) > 0)
            if near.sum() < 4:
                continue
            # a phase of n independent events whose sum is z is uncertain by sqrt(n / 2) / |z|: at the end of
            # a recording some late events would turn the line
            sure = np.abs(part[near]) ** 2 / count[i : i + size][near]
            sure /= sure.mean()
            away = at[near] - np.average(at[near], weights=sure)
            spread = float((sure * away**2).sum())
            slope = float((sure * away * turn[near]).sum() / spread)
            rest = turn[near] - np.average(turn[near], weights=sure) - slope * away
            weights.append(spread / max(float((sure * rest**2).sum()) / max(near.sum() - 2, 1), 1e-12))
            slopes.append(slope)
        if not slopes:
            break
        value += float(np.average(slopes, weights=weights))
        error = 1 / math.sqrt(sum(weights))
    z = (net * np.exp(-2j * np.pi * value * time)).sum(1)
    swing = []
    for i in range(0, blocks, size):
        part, n = z[i : i + size], count[i : i + size]
        if abs(part.sum()) > 0:
            # relative to the mean events of a block: few events count little
            swing.append((part * np.conj(part.sum())).real / abs(part.sum()) / max(n.mean(), 1e-9))
    return value, error, np.concatenate(swing) if swing else np.zeros(2)


def _tiles_in_phase(
    rates: _Rates, step: float, frequency: float, s: FlickerSettings
) -> tuple[float, int, int]:
    """Return the chance that tiles agree so well with the others, how many do, and how many there are.

    Edges that move have a phase of their own in each tile: within an eighth of a turn of the others' by a
    chance of 1/4.
    """
    time = (np.arange(len(rates.usual)) + 0.5) * step
    size = round(s.segment / step)
    relation = np.zeros(rates.net.shape[1], np.complex128)
    for i in range(0, len(time), size):
        turn = np.exp(-2j * np.pi * frequency * time[i : i + size])
        z = turn @ rates.net[i : i + size]
        relation += z * np.conj(z.sum() - z)
    count = rates.events.sum(0)
    good = count > max(200.0, 0.003 * count.sum())
    away = np.angle(relation[good]) / (2 * np.pi)
    agree = int(np.count_nonzero(np.abs(away) < s.agree))
    return float(stats.binom.sf(agree - 1, len(away), 2 * s.agree)), agree, len(away)


def find_flicker(
    clock: ClockCounts,
    level: float,
    bursts: BurstClock | None = None,
    doubtful: float = 0.0,
    settings: FlickerSettings | None = None,
) -> tuple[Signature, Lamp | None]:
    """Look for a tone that the whole array follows.

    Args:
        clock: The events by time.
        level: p below which it is there.
        bursts: Times to leave out.
        doubtful: Interval of bursts that may be there [s]: a tone at a multiple of their rate may be theirs.
        settings: How tones are looked for.
    """
    s = settings or FlickerSettings()
    step = clock.settings.step
    duration = len(clock.counts) * step
    if duration < s.fewest_blocks * s.block:
        blocks = f"{s.fewest_blocks} blocks of {format_seconds(s.block)}"
        reason = f"{format_seconds(duration)} of events: less than {blocks}"
        return without_answer(FLICKER, reason), None
    rates = _net_rates(clock, bursts, s)
    events = int(rates.events.sum())
    if events < s.fewest_events:
        return without_answer(FLICKER, f"{events} events, fewer than {s.fewest_events}"), None
    v = rates.net.sum(1) / (rates.usual + 1)
    tone, p_tone, many, found_by = _find_tone_in_blocks(v, step, bursts, s, level)
    p_tiles, agree, tiles = _tiles_in_phase(rates, step, tone, s)
    if found_by is not s:  # what moves keeps its phase from one short block to the next more often
        p_tiles = min(1.0, s.short_tiles * p_tiles)
    if stats.binom.sf(tiles - 1, tiles, 2 * s.agree) >= level and p_tone < level:
        reason = f"{tone:.1f} Hz, but only {tiles} of {s.tiles**2} tiles have events to agree on it"
        return without_answer(FLICKER, reason, p=p_tiles), None
    frequency, error, swings = _refine_tone(rates, step, tone, found_by)
    mean, low, high = mean_interval(swings)
    entry = Signature(
        name=FLICKER, answer=Answer.NOT_SEEN, p=max(p_tone, p_tiles), size=mean, low=low, high=high,
        unit="swing, share of the rate", least=s.least,
        sentence=f"light at {frequency:.2f} Hz, swing {mean:.2g} of the rate, "
        f"one phase in {agree} of {tiles} tiles",
        details={
            "frequency": frequency, "frequency_low": frequency - NINETY * error,
            "frequency_high": frequency + NINETY * error, "tones": many,
            "tiles_in_phase": agree, "tiles": tiles, "p_tone": p_tone, "p_tiles": p_tiles,
        },
    )  # fmt: skip
    top = max(high, 0.0)
    unseen = f"no tone of one phase, {found_by.slowest:g} to {s.fastest:g} Hz: swing at most {top:.2g}"
    found = judge_signature(entry, level, unseen)
    if not found.found:
        return found, None
    turns = frequency * doubtful
    if frequency < s.slowest_lamp:
        reason = f"{frequency:.2f} Hz: no lamp is as slow, frames are"
        return replace(found, answer=Answer.CANNOT_SAY, sentence=reason), None
    longer = 0.0 if bursts is not None else _longer_period(v, step, frequency, s)
    if longer:
        reason = f"{frequency:.2f} Hz, of what repeats after {format_seconds(longer)} only: no lamp's light"
        return replace(found, answer=Answer.CANNOT_SAY, sentence=reason), None
    if doubtful and abs(turns - round(turns)) < 0.75 * doubtful / duration:
        reason = f"{frequency:.2f} Hz, or bursts every {format_seconds(doubtful)} of which it is a multiple"
        return replace(found, answer=Answer.CANNOT_SAY, sentence=reason), None
    left = format_percent(1 - float(rates.kept.mean()))
    if bursts is not None:
        found = replace(found, sentence=f"{found.sentence}; read off with {left} of the time left out")
    return found, Lamp(frequency)
