"""The signatures that there are, by name, and what holds of each whatever effect makes it.

Which effects make one is said by these, see `dase.effects.Effect.signatures`.
"""

from __future__ import annotations

from dataclasses import dataclass

FLICKER = "flicker"
HOT_PIXELS = "hot pixels"
FULL_BUS = "full bus"
RATE_LIMIT = "rate limit"
TIME_STAMPS = "time stamps"
OPPOSITE_PAIRS = "opposite pairs"
FIXED_PATTERN = "fixed pattern"
GROUPING = "grouping"
FRAME_COUPLING = "frame coupling"
DOUBLE_EVENTS = "double events"
DEAD_TIME = "dead time"
LEAK_EVENTS = "leak events"
NOISE_AT_REST = "noise at rest"
UNEQUAL_THRESHOLDS = "unequal thresholds"
DRIFTING_MEMORY = "drifting memory"
REDRAWN_THRESHOLDS = "redrawn thresholds"
LATE_EVENTS = "late events"
LARGER_STEPS_IN_THE_DARK = "larger steps in the dark"
KINKED_RESPONSE = "kinked response"
KINK_AT_CORNERS = "kink at the corners"
CURRENT_AT_CORNERS = "current at the corners"


@dataclass(frozen=True, kw_only=True)
class SignatureKind:
    """What holds of a signature wherever it is seen.

    Args:
        name: As in `dase.signatures.result.Signature`.
        about: What events do, in a line.
        ways: Details that only some of these signatures have, by which they tell effects apart: of time
            stamps the time between ticks, in the median where these are packets, or that of a line [s], of
            noise the share of successive events that are opposite, where these are independent or return, of
            late events by how much they are, or the poles that light is behind, of larger steps in the dark
            the current or the knee that makes them.
        beside_model: Whether it is what a model over the same scene lacks: events alone do not show it.
        whatever_fits: Whether it is there however badly that model fits.
        of_light: Whether light makes it by itself: a scene may show it to any sensor, and an effect that
            makes it changes the light.
        denies: Whether effects that make it are in doubt where it would have been seen and is not.
        without: What to record so that it is not there and hides nothing else; "" where nothing is told.
    """

    name: str
    about: str
    ways: tuple[str, ...] = ()
    beside_model: bool = False
    whatever_fits: bool = False
    of_light: bool = False
    denies: bool = False
    without: str = ""


KINDS: dict[str, SignatureKind] = {
    kind.name: kind
    for kind in (
        SignatureKind(
            name=FLICKER,
            about="the rate of all pixels swings at one frequency",
            of_light=True,
            without="the same under light that does not flicker (direct current, daylight)",
        ),
        SignatureKind(name=HOT_PIXELS, about="some pixels send far more than their neighbours", denies=True),
        SignatureKind(name=FULL_BUS, about="the event rate has a ceiling, or events keep a distance in time"),
        SignatureKind(name=RATE_LIMIT, about="in even periods never more than so many events pass"),
        SignatureKind(
            name=TIME_STAMPS,
            about="times are multiples of a step or those of packets, or lines of pixels are read in turn",
            ways=("step", "line"),
        ),
        SignatureKind(name=OPPOSITE_PAIRS, about="pixels at rest send an event and then its opposite"),
        SignatureKind(name=FIXED_PATTERN, about="each pixel has a balance of ON and OFF events of its own"),
        SignatureKind(name=GROUPING, about="successive events share a row or a column"),
        SignatureKind(
            name=FRAME_COUPLING,
            about="the whole array sends in bursts, in step with frames",
            without="the same with frames off, beside a clip of the scene: bursts come with the frames",
        ),
        SignatureKind(name=DOUBLE_EVENTS, about="pixels send twice within microseconds"),
        SignatureKind(name=DEAD_TIME, about="the intervals of a pixel end as if cut off", beside_model=True),
        SignatureKind(
            name=LEAK_EVENTS,
            about="pixels send ON events while their light rests",
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=NOISE_AT_REST,
            about="pixels send ON and OFF events while their light rests",
            ways=("independent", "returning"),
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=UNEQUAL_THRESHOLDS,
            about="how far light goes between two events differs from pixel to pixel",
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=DRIFTING_MEMORY,
            about="the longer a pixel waits, the less far light goes to ON events, the farther to OFF",
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=REDRAWN_THRESHOLDS,
            about="how far light goes between two events differs each time",
            beside_model=True,
        ),
        SignatureKind(
            name=LATE_EVENTS,
            about="light goes equally far between two events some time before these, or behind poles",
            ways=("delay", "pole", "poles"),
            beside_model=True,
        ),
        SignatureKind(
            name=LARGER_STEPS_IN_THE_DARK,
            about="the darker it is, the farther light goes between two events",
            ways=("current", "knee"),
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=KINKED_RESPONSE,
            about="below a grey light goes far less far between two events, as by the response of v2e",
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=KINK_AT_CORNERS,
            about="that grey lies at more light of the scene the nearer a corner is",
            beside_model=True,
            whatever_fits=True,
        ),
        SignatureKind(
            name=CURRENT_AT_CORNERS,
            about="a current without light is more of the scene's light the nearer a corner is",
            beside_model=True,
            whatever_fits=True,
        ),
    )
}
"""Name to what holds of the signature."""
