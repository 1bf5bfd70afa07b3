"""What a physical effect is to dase."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from dase.effects.made_signatures import Makes
from dase.errors import InputError, nearest
from dase.events import LABELS
from dase.kernels import pixel_stages

if TYPE_CHECKING:
    from dase.scenes.scene import Scene


ANY_SAMPLES = 1e6
"""Time between samples [s] of what goes on at each sample of the scene, however far apart they are."""

Starts = Literal["value", "ends", "spread", "turn", "above"]
"""Where a search begins along a parameter of an effect that is tried:

- `value`: where the effect has it, for what a descent finds from anywhere;
- `ends`: there and near the upper end of the plausible range, for what changes the character of the effect;
- `spread`: all over the plausible range, for the strength of an effect;
- `turn`: all round a turn, for a phase [turns];
- `above`: where the effect has it and somewhat above, for a bound that the measurement shows from below.
"""


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, and all that a search needs to know of it.

    Args:
        name: As in the sensor file.
        unit: SI, or `1` for a ratio.
        default: A typical value.
        off: The value at which the effect changes nothing, or None if another parameter switches it off.
        bounds: Values outside are refused.
        plausible: Where real cameras lie; a diagnosis looks for the effect in this range.
        about: One line.
        starts: Where a search begins, see `Starts`; "" for `spread` where there is a value at which the
            effect is off, else `value`.
        periodic: Whether it is a phase [turns]: what statistics do along it goes round, so steps are small,
            and the search may go through all of the bounds.
        fitted: Whether a fit may change it unless it is named; False for what a search by small steps cannot
            find, which is set by other means.
        nearby: Relative range about its value to which a fit keeps, for what is read off the measurement
            better than a fit can find it; such a parameter stays as it is while its effect is tried. None
            for the whole range.
        between_samples: Whether a time that is short beside the steps in which light is known is told by what
            light does between them, where it is a guess: so is what a memory does there.
        farthest: Largest value to which a search goes, or the effect's own if that is larger, where less than
            three times the plausible range does: what is beyond would cost much and tell nothing more.
        clear_from: Smallest value that is clear by a fit alone: other worlds look like one that is smaller.
        clear_beside: (name, value) pairs of effects beside which a smaller value is in doubt: another way in
            which a world does those looks like it.
        over_pixels: Whether it says how far pixels differ in the contrast at which they send, by chance: what
            differs from place to place looks like it, see `Effect.light_left`.
    """

    name: str
    unit: str
    default: float
    off: float | None
    bounds: tuple[float, float]
    plausible: tuple[float, float]
    about: str
    starts: Starts | Literal[""] = ""
    periodic: bool = False
    fitted: bool = True
    nearby: float | None = None
    between_samples: bool = False
    farthest: float = math.inf
    clear_from: float = 0.0
    clear_beside: tuple[tuple[str, float], ...] = ()
    over_pixels: bool = False

    @property
    def search_starts(self) -> Starts:
        """Where a search begins, worked out where it was not said."""
        return self.starts or ("value" if self.off is None else "spread")


def parameter(
    default: float,
    *,
    unit: str,
    about: str,
    off: float | None = None,
    bounds: tuple[float, float] = (0.0, math.inf),
    plausible: tuple[float, float],
    starts: Starts | Literal[""] = "",
    periodic: bool = False,
    fitted: bool = True,
    nearby: float | None = None,
    between_samples: bool = False,
    farthest: float = math.inf,
    clear_from: float = 0.0,
    clear_beside: tuple[tuple[str, float], ...] = (),
    over_pixels: bool = False,
) -> Any:
    """Declare a parameter of an effect; see `Parameter`."""
    facts = dict(
        unit=unit, default=default, off=off, bounds=bounds, plausible=plausible, about=about, starts=starts,
        periodic=periodic, fitted=fitted, nearby=nearby, between_samples=between_samples,
        farthest=farthest, clear_from=clear_from, clear_beside=clear_beside, over_pixels=over_pixels,
    )  # fmt: skip
    return field(default=default, metadata={"parameter": facts})


def choice(default: str, *, among: tuple[str, ...], about: str) -> Any:
    """Declare an option of an effect that is a word, not a number."""
    return field(default=default, metadata={"choice": among, "about": about})


def asset(*, about: str) -> Any:
    """Declare a file that an effect needs, by its path from the sensor file; "" is none."""
    return field(default="", metadata={"asset": True, "about": about})


def hidden() -> Any:
    """Declare what an effect carries along that is not in sensor files."""
    return field(default=None, repr=False, compare=False, metadata={"hidden": True})


@dataclass(frozen=True)
class Observations:
    """What can be read off a measurement without any model, from which an effect may choose its candidates.

    Args:
        peak_frequency: At which the net event rate of all pixels swings most [Hz].
        clock_period: Time between the ticks that all time stamps are multiples of [s], 0 for none.
        line_time: Time from line to line of a readout that visits them in turn [s], 0 for none.
        scan_direction: Where that readout goes: down, up, right or left.
        highest_event_rate: Most events per second of all pixels together, over some milliseconds [Hz].
        bus_loss: Share of the events that found a bus busy, if there is one, at most.
        idle_bus: Largest such share of a bus that is idle: without a queue it would hardly lose anything.
        frame_interval: Time between bursts of the whole array in step with frames [s], 0 for none.
        frame_begin: When one of the bursts of ON events comes [s].
        frame_exposure: From there to the next burst of OFF events [s].
        peak_chance: Probability that independent events swing as much as these do at `peak_frequency`.
        clip_step: From frame to frame of a clip in step with which all events come [s], as those of a
            simulator that works frame by frame do; 0 for none.
        clip_frames: From frame to frame of a clip [s], whatever the events; 0 for other scenes.
        least_bus_rate: Events per second that a bus which sends one event after the other, if there is one,
            can send at least [Hz]: it has sent some as fast as that.
        bus_load: Largest share of some milliseconds for which a bus that sends one event after the other, if
            there is one, was busy at most.
        row_load: The same of an arbiter that takes rows.
        column_load: The same of one that takes columns.
        stamped_again: Share of the events that a scan has stamped like the one before of their pixel.
        double_gap: Mean time from an event to its double [s] where pixels are seen to send twice, else 0.
        double_spread: How far these times are apart, evenly [s]; 0 where they hardly differ.
        double_opposite: Whether the double has the other polarity.
        unlike_poles: Of light that events are seen to be behind: cutoff of a pole that goes with the light,
            at intensity 1 [Hz], its photocurrent at intensity 0 relative to that, and the cutoff of one that
            does not [Hz]; empty where they are not.
    """

    peak_frequency: float
    clock_period: float
    line_time: float
    scan_direction: str
    highest_event_rate: float
    bus_loss: float
    idle_bus: float
    frame_interval: float = 0.0
    frame_begin: float = 0.0
    frame_exposure: float = 0.0
    peak_chance: float = 0.0
    clip_step: float = 0.0
    clip_frames: float = 0.0
    least_bus_rate: float = 0.0
    bus_load: float = math.inf
    row_load: float = math.inf
    column_load: float = math.inf
    stamped_again: float = 0.0
    double_gap: float = 0.0
    double_spread: float = 0.0
    double_opposite: bool = False
    unlike_poles: tuple[float, ...] = ()

    @property
    def bus_is_idle(self) -> bool:
        """Whether a bus, if there is one, is free nearly always."""
        return self.bus_loss < self.idle_bus


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One physical effect of an event camera, the extension point of dase.

    A subclass is a frozen dataclass whose fields are made by `parameter` (numbers, which may be fitted) and
    `choice`. Its docstring is the plain-language description. `stages` maps a stage of
    `dase.kernels.pixel_stages` to a Warp function; the arguments of such a function are resolved by name.
    """

    name: ClassVar[str]
    """Name in sensor files and on the command line."""
    source: ClassVar[str]
    """Authors, title, year."""
    stages: ClassVar[Mapping[str, Any]]
    """Stage name to Warp function."""
    states: ClassVar[tuple[str, ...]] = ()
    """What a pixel remembers from sample to sample."""
    includes: ClassVar[tuple[str, ...]] = ()
    """Names of effects that this one becomes at the end of its range: it explains all that they do."""
    maps: ClassVar[tuple[str, ...]] = ()
    """Quantities of which every pixel has its own value, depending on the scene; see `bound_to`."""
    unbroken: ClassVar[bool] = False
    """Whether it goes by a clock of its own or remembers for seconds: a recording is then compared in one
    stretch of time, see `dase.fitting.time_window`."""
    rare: ClassVar[bool] = False
    """Whether it acts on so few pixels that some hundred of them do not show it."""
    label: ClassVar[str] = "shot"
    """What the events of its `noise` stage are marked as, one of `dase.events.LABELS`."""
    signatures: ClassVar[tuple[Makes, ...] | None] = None
    """All signatures that it makes, () for none. None where that is not known: then it may make any that is
    seen beside a model, and these name no effect of a library that it is in."""
    screen_limits: ClassVar[Mapping[str, str]] = {}
    """What a test picture on a screen cannot tell of it, and what would: a parameter, or "" for all of it, to
    half a sentence, in which `{refresh:g}` is how often the screen changes and `{highest_cutoff:g}` up to
    which frequency it tells a cutoff [Hz]."""

    def __post_init__(self) -> None:
        for p in self.parameters():
            value = getattr(self, p.name)
            where = f"{self.name}.{p.name}"
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise InputError(f"{where} must be a number [{p.unit}], got {value!r}")
            low, high = p.bounds
            try:
                value = float(value)
            except OverflowError:
                digits = round(math.log10(abs(value))) + 1
                raise InputError(f"{where}: a whole number of {digits} digits is too large") from None
            if not low <= value <= high:
                raise InputError(f"{where} must lie in [{low:g}, {high:g}] {p.unit}, got {value:g}")
        for name, among in self.choices().items():
            if getattr(self, name) not in among:
                raise InputError(
                    f"{self.name}.{name} must be one of {', '.join(among)}, got {getattr(self, name)!r}"
                )

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return the numbers of this effect, in the order of its fields."""
        return _parameters_of(cls)  # type: ignore[arg-type]  # mypy takes a class for unhashable

    @classmethod
    def choices(cls) -> dict[str, tuple[str, ...]]:
        """Return the words an option of this effect may take."""
        return {f.name: f.metadata["choice"] for f in dataclasses.fields(cls) if "choice" in f.metadata}

    @classmethod
    def variants(cls) -> list[Self]:
        """Return this effect with each combination of its words, its numbers at their defaults."""
        out = [cls()]
        for name, words in cls.choices().items():
            out = [dataclasses.replace(effect, **{name: word}) for effect in out for word in words]
        return out

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the variants of this effect with which a diagnosis tries to explain a measurement.

        An effect sets here what no search by small steps finds but the measurement shows, and returns nothing
        where the measurement shows that it is not there.
        """
        return cls.variants()

    def shifted(self, seconds: float) -> Effect:
        """Return this effect as it is on a clock that shows `seconds` less.

        Only what repeats in time by a phase of its own need do so: a descent may end a step of the grid off.
        """
        return self

    def in_step(self, observed: Observations) -> Effect:
        """Return this effect at the times of what comes from outside, as a measurement shows them.

        Only what follows a clock that no sensor file knows, such as that of the frames, need do so.
        """
        return self

    @classmethod
    def assets(cls) -> dict[str, str]:
        """Return the files this effect needs, name to what they are."""
        return {f.name: f.metadata["about"] for f in dataclasses.fields(cls) if "asset" in f.metadata}

    @classmethod
    def settings(cls) -> list[str]:
        """Return the names of all that a sensor file says about this effect."""
        return [f.name for f in dataclasses.fields(cls) if "hidden" not in f.metadata]

    def located(self, folder: Path) -> Effect:
        """Return this effect with its files found from `folder`, in which the sensor file lies."""
        return self

    def bound_to(self, scene: Scene) -> Effect:
        """Return this effect with its maps for a scene."""
        return self

    def map_values(self, pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the maps of `bound_to` at row-major indices of pixels (N,), shape (M, N)."""
        raise NotImplementedError

    @classmethod
    def identity(cls) -> Effect:
        """Return this effect switched off: it changes nothing, bit for bit."""
        return cls(**{p.name: p.off for p in cls.parameters() if p.off is not None})

    def is_off(self) -> bool:
        """Whether this effect changes nothing."""
        return all(getattr(self, p.name) == p.off for p in self.parameters() if p.off is not None)

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Effect:
        """Make the effect from a table of a sensor file; raises InputError for an unknown name."""
        known = cls.settings()
        for name, value in table.items():
            if name not in known:
                raise InputError(f"effect '{cls.name}' has no parameter '{name}': {nearest(name, known)}")
            if name in cls.assets() and not isinstance(value, str):
                raise InputError(f"{cls.name}.{name} must be the path of a file, got {value!r}")
        return cls(**table)

    def simpler(self) -> tuple[Effect, ...]:
        """Return the effects of `includes` as they do most nearly what this one does."""
        return ()

    def delays(self) -> bool:
        """Whether events that this effect holds back come later instead of being lost."""
        return False

    def resets(self) -> bool:
        """Whether this effect holds a pixel in reset: it memorises the light at the end of its dead time."""
        return False

    def spares_noise(self) -> bool:
        """Whether random events pass while this effect holds the others back, and begin no dead time."""
        return False

    def stood_in_for(self, beside: Sequence[Effect]) -> dict[str, float]:
        """Return values of parameters that those of other effects stand for where this one is missing.

        A search begins there, too: with this effect those others change nothing any more.
        """
        return {}

    def light_left(self) -> tuple[float, ...]:
        """Return shares of the light that are left to pixels, where more is left to some than to others.

        A model without this effect is fitted to the mean of what pixels get: the intensities at which its
        other effects act are too high by as much, and it has pixels differ by chance that differ by their
        place. Where this effect is tried, a search begins with both put right, too, by each of these shares.
        () where all pixels get the same light.
        """
        return ()

    def swing_left(self, light: NDArray[np.float64]) -> float:
        """Return the share of the changes of log light that this effect leaves to pixels.

        So much lower are the thresholds at which as many events come as without it: where this effect is
        tried, a search begins there, too.

        Args:
            light: Intensities, and what is added before the logarithm, of some pixels on a grid of time,
                shape (N, T).
        """
        return 1.0

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return this effect by the other rules that a fit has to try, too, as no descent gets there.

        Args:
            beside: The effects that are on beside it.
        """
        return []

    def by_other_laws(self) -> list[Self]:
        """Return this effect by other laws that `dase.fit` has to fit, too, before any of them looks better.

        A diagnosis, which fits many models, has no time for them.
        """
        return []

    def begins_at_the_light(self) -> bool:
        """Whether this effect belongs to a world whose memories begin at the first light, all alike."""
        return False

    def idle(self, beside: Sequence[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters that change nothing, by the words that this effect has.

        Args:
            beside: The effects of the same sensor.
        """
        return ()

    def lends(self) -> tuple[str, ...]:
        """Return the names of the parameters that other effects follow, see `dase.kernels.pixel_stages.LENT`.

        They do where this effect is on.
        """
        return ()

    def share_that_tells(self, name: str) -> float:
        """Return the share of the pixels that tell a parameter, each by a value that chance has given it.

        Where these are few, an interval is as wide as Student's law for as many.

        Args:
            name: Of the parameter.
        """
        return 1.0

    def knows_samples_alone(self) -> bool:
        """Whether this effect goes from one sample of a scene to the next, with nothing between them."""
        return False

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        return math.inf

    def compiled(self) -> pixel_stages.EffectStages:
        """Return what the kernel composer needs to know."""
        for stage in self.stages:
            if stage not in pixel_stages.STAGES:
                has = nearest(stage, pixel_stages.STAGES)
                raise InputError(f"effect '{self.name}' has a function for stage '{stage}': {has}")
        return pixel_stages.EffectStages(
            name=self.name,
            functions=tuple(self.stages.items()),
            parameters=tuple(p.name for p in self.parameters()),
            states=self.states,
            delays=self.delays(),
            resets=self.resets(),
            spares_noise=self.spares_noise(),
            label=LABELS.index(self.label),
            maps=self.maps,
            lends=self.lends(),
            off=tuple((p.name, p.off) for p in self.parameters() if p.off is not None),
        )

    @classmethod
    def about(cls) -> str:
        """Return the plain-language description."""
        return inspect.cleandoc(cls.__doc__ or "")


@cache
def _parameters_of(effect: type[Effect]) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(f.name, **f.metadata["parameter"])
        for f in dataclasses.fields(effect)
        if "parameter" in f.metadata
    )
