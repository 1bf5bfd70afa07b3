"""What a screen cannot tell of a sensor, and what would, as its effects say it."""

from __future__ import annotations

from collections.abc import Iterable

from dase.effects import Effect
from dase.scenes.screen_stimulus import ScreenStimulus
from dase.simulation.sensor import Sensor

HELD = 0.25
"""Share of the refresh rate up to which a screen tells a cutoff: faster pixels are done before the next
frame, and how fast the screen itself changes from frame to frame nobody has measured."""


def screen_limits_of(effects: Iterable[type[Effect]], stimulus: ScreenStimulus) -> dict[str, str]:
    """Return what a stimulus on a screen does not reach: `effect` or `effect.parameter` to half a sentence.

    Args:
        effects: Whose parameters are wanted.
        stimulus: What the screen shows.
    """
    values = {"refresh": stimulus.refresh, "highest_cutoff": HELD * stimulus.refresh}
    return {
        f"{effect.name}.{parameter}" if parameter else effect.name: limit.format_map(values)
        for effect in effects
        for parameter, limit in effect.screen_limits.items()
    }


def notes_on_screen(sensor: Sensor, stimulus: ScreenStimulus) -> list[str]:
    """Return a sentence for each effect or parameter of a sensor that a stimulus on a screen does not reach.

    Args:
        sensor: Whose parameters are wanted.
        stimulus: What the screen shows.
    """
    limits = screen_limits_of((type(effect) for effect in sensor.effects), stimulus)
    return [f"not told by a screen, {name}: {limit}" for name, limit in limits.items()]
