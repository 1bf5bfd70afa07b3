"""What a screen cannot tell of a sensor, and what would: one sentence for each."""

from __future__ import annotations

from collections.abc import Callable

from dase.scenes.screen_stimulus import ScreenStimulus
from dase.simulation.sensor import Sensor

HELD = 0.25
"""Share of the refresh rate up to which a screen tells a cutoff: faster pixels are done before the next
frame, and how fast the screen itself changes from frame to frame nobody has measured."""

SCREEN_LIMITS: dict[str, Callable[[ScreenStimulus], str]] = {
    "bandwidth.cutoff": lambda s: (
        f"a cutoff above about {HELD * s.refresh:g} Hz wants an LED, as a screen of {s.refresh:g} Hz needs "
        "1 to 10 ms for a change itself"
    ),
    "second_order": lambda s: (
        f"a cutoff above about {HELD * s.refresh:g} Hz and the damping want an LED, as the screen rings and "
        "lags itself"
    ),
    "latency": lambda s: (
        "the delay is not told by a screen: its own lag cannot be known apart; an LED beside a trigger input "
        "tells it"
    ),
    "voltage_noise.cutoff": lambda s: (
        "the noise's cutoff wants constant light: an LED on DC, not a backlight"
    ),
    "dark": lambda s: (
        "dark current wants a lens cap: black of a screen is some 0.1 % of white, and the room adds to it"
    ),
    "leak.rate": lambda s: "a leak wants minutes at rest, in even light or under a lens cap",
    "leak.light": lambda s: (
        "how leak grows with light wants more light than a screen has: an LED or daylight, at rest"
    ),
    "shot.rate": lambda s: (
        "shot noise wants darkness for seconds: a lens cap; a screen's black shows only part of it"
    ),
    "shot.bright": lambda s: (
        "how shot noise falls with light wants decades of light: grey filters, or an LED and a lens cap"
    ),
    "hot": lambda s: "hot pixels are told best under a lens cap, for some seconds",
    "refractory.period": lambda s: (
        "a dead time wants steps that are fast and large: an LED, or the edge of a print that is moved fast"
    ),
    "linlog": lambda s: (
        "the knee wants light far below a screen's black: a lamp and grey filters over four decades"
    ),
    "flicker": lambda s: (
        "flicker found before a screen may be that of its backlight: it is light, and not of the camera"
    ),
    "vignetting": lambda s: (
        "vignetting cannot be told from a screen that is darker at its corners: an evenly lit sheet tells it"
    ),
    "readout": lambda s: (
        "a full bus wants more events at once: flashes of an LED that all pixels see, or a fast print"
    ),
    "row_scan": lambda s: "the order of rows wants an LED: a screen is drawn row after row itself",
    "timestamp": lambda s: "jitter of time stamps wants an LED, whose edges last less than a microsecond",
}
"""Effects, or their parameters, that a screen does not reach."""


def limits_of_screen(sensor: Sensor, stimulus: ScreenStimulus) -> list[str]:
    """Return a sentence for each effect or parameter of a sensor that a stimulus on a screen does not reach.

    Args:
        sensor: Whose parameters are wanted.
        stimulus: What the screen shows.
    """
    names = {type(effect).name for effect in sensor.effects}
    return [
        f"not told by a screen, {key}: {say(stimulus)}"
        for key, say in SCREEN_LIMITS.items()
        if key.partition(".")[0] in names
    ]
