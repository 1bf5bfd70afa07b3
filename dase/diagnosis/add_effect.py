"""An effect added to a sensor and fitted: what the error was without it, and what it is with it."""

from __future__ import annotations

from collections.abc import Callable

from dase.diagnosis.candidates import screen_and_descend
from dase.effects import Effect
from dase.events import Events
from dase.fitting.data_split import PIXELS, split_measurement
from dase.fitting.fit import fit
from dase.fitting.model import fit_present_model
from dase.probes.stimulus import Trust
from dase.results import Fit
from dase.scenes.scene import Scene
from dase.simulation.sensor import Sensor


def fit_added(
    events: Events,
    scene: Scene,
    sensor: Sensor,
    effect: Effect,
    *,
    trust: Trust | None = None,
    pixels: int = PIXELS,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[str, float, float], None] | None = None,
) -> tuple[float, Fit]:
    """Add an effect to a sensor and fit all its parameters to a measurement.

    Args:
        events: What was measured.
        scene: What the camera saw, on the clock of the events.
        sensor: Without the effect.
        effect: Its values are where the search begins, among others.
        trust: Where and when the scene is to be trusted; None for everywhere, and for what a
            `CameraScene` trusts of itself.
        pixels: In each half of the measurement.
        seed: Of every random number.
        device: Where kernels run.
        progress: Told how far it is.

    Returns:
        Held-out error of the sensor without the effect, fitted as well as it can be, and the fit with it.
    """
    tell = progress or (lambda text, share, error: None)
    sensor, effect = sensor.bound_to(scene), effect.bound_to(scene)
    evidence = split_measurement(
        events, scene, log_eps=sensor.log_eps, trust=trust, pixels=pixels, seed=seed, device=device
    )
    tell("fitting without the effect", 0.0, float("nan"))
    present = fit_present_model(evidence, sensor, None, seed=seed)
    before = present.judge(evidence.held, repeats=30, seed=seed + 500).error
    tell(f"where to begin with {effect.name}", 0.1, before)
    # far from where it is, a descent could end in the wrong place
    present.rebase(evidence.scout, repeats=16, seed=seed + 200)
    start = screen_and_descend(evidence, present, effect, seed=seed).model.sensor
    fitted = fit(
        events, scene, start, trust=trust, pixels=pixels, seed=seed, device=device, progress=progress
    )
    return before, fitted
