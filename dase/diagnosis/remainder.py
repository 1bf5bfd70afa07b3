"""What a diagnosis leaves unexplained: where it sits, what of it may be the scene's, what to record next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dase.diagnosis.cell_descriptions import KINDS_OF_PIXELS, kind_of_pixels
from dase.diagnosis.settings import DEFAULTS
from dase.diagnosis.state import DiagnosisTask
from dase.effects import Effect
from dase.effects.made_signatures import makers_of
from dase.fitting.model import FittedModel
from dase.fitting.scene_doubt import is_guessed
from dase.fitting.time_window import is_constant
from dase.formatting import format_metric
from dase.probes.distance import Judgement, pseudo_huber
from dase.probes.random_streams import SimulationStream
from dase.probes.statistics import LAYOUT
from dase.results import Cell, Finding, Grade, Unexplained
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.signatures.kinds import KINDS


@dataclass(frozen=True)
class AdviceSettings:
    """When it is said what to record next."""

    much: float = 0.35
    """Share of what is left that must sit in pixels of one kind, or be the scene's."""

    blurred: float = 0.25
    """Share of the time between frames that exposures take, from which on they blur what moves."""


ADVICE = AdviceSettings()


def describe_unexplained(
    nearest: Sequence[str],
    findings: Mapping[str, Finding],
    first: Judgement,
    last: Judgement,
    cells: tuple[Cell, ...],
    of_scene: float = 0.0,
    usual: float = DEFAULTS.grades.usual,
) -> Unexplained:
    """Return what is left, how much of the error that is, and where it sits.

    Args:
        nearest: Stand-ins: effects of the last model that are not found.
        findings: What was found.
        first: Error of the model before the search.
        last: Error of the last model.
        cells: Where it fails.
        of_scene: Share of what the last model is off by that the scene may be blamed for.
        usual: Error that true models have.
    """
    level = max(last.level, usual)
    share = max(last.error - level, 0.0) / max(first.error - level, 1e-9)
    where = f"; worst: {cells[0].sentence}" if cells else "; no single cell stands out"
    left = f"an error of {last.error:.2g}, {100 * share:.0f} % of that before the search"
    if findings:
        beside = (
            f" even with {' and '.join(nearest)}, which come nearest and are not found," if nearest else ""
        )
        sentence = f"beside that{beside} {left}, stays unexplained{where}"
    else:
        beside = f"with {' and '.join(nearest)}, which come nearest, " if nearest else "with no effect "
        sentence = f"unexplained: {beside}{left}, is left{where}"
    return Unexplained(last.error, share, tuple(nearest), cells, sentence, of_scene, shares_by_pixels(last))


def shares_by_pixels(judgement: Judgement) -> dict[str, float]:
    """Return the share of an error that sits in pixels of each kind, kinds in the order of their share."""
    rho, out = pseudo_huber(judgement.z), dict.fromkeys(KINDS_OF_PIXELS, 0.0)
    for family, part in LAYOUT.items():
        used = judgement.compared[part]
        for n in np.flatnonzero(used):
            # families weigh alike
            out[kind_of_pixels(family, int(n))] += float(rho[part][n]) / np.count_nonzero(used)
    whole = max(sum(out.values()), 1e-12)
    return {kind: out[kind] / whole for kind in sorted(out, key=lambda kind: -out[kind])}


def share_of_scene(task: DiagnosisTask, model: FittedModel, last: Judgement) -> float:
    """Return the share of what a model is off by that its scene may be blamed for.

    Without what the scene is not known to, the error would be larger: that much of it may be the scene's.

    Args:
        task: What the diagnosis is asked.
        model: The last one.
        last: Its error on the part that reports.
    """
    report = task.evidence.report
    if report.doubt is None:
        return 0.0
    stream, repeats = SimulationStream.JUDGE.seed(task.seed), task.settings.grades.repeats
    bare = model.judge(replace(report, doubt=None, drift=None), repeats=repeats, seed=stream)
    whole = max(bare.error - bare.level, 1e-9)
    return float(np.clip(1.0 - max(last.error - last.level, 0.0) / whole, 0.0, 1.0))


def what_to_record(
    scene: Scene,
    findings: Sequence[Finding],
    unexplained: Unexplained | None,
    effects: Mapping[str, type[Effect]],
    *,
    contradiction: bool = False,
    settings: AdviceSettings = ADVICE,
) -> tuple[str, ...]:
    """Return what to record next, so that more can be said, most useful first; nothing where all is said.

    Args:
        scene: What the camera saw.
        findings: What was found.
        unexplained: What is left; None for nothing.
        effects: Those that may be found, by name.
        contradiction: Whether the events cannot be of the scene.
        settings: When something is said.
    """
    if contradiction:
        return ("what the camera saw, by its own frames or a clip; or the camera with its lens cap on",)
    out = []
    either = [one for one in findings if one.grade is Grade.EITHER]
    told = [one for one in either if one.alternatives]
    if told:
        names = " from ".join((told[0].effect, told[0].alternatives[0]))
        out.append(f"what `dase distinguish` proposes to tell {names}: make a sensor file of each")
    elif either:
        out.append(f"the same for longer: {either[0].effect} is too weak to be told from something unknown")
    if unexplained is None:
        return tuple(out)
    places = unexplained.places
    guessed = is_guessed(scene) and isinstance(scene, CameraScene)
    if guessed and (unexplained.of_scene >= settings.much or places.get("moving", 0.0) >= settings.much):
        out += _better_frames(scene, settings)
    if places.get("resting", 0.0) >= settings.much and not is_constant(scene):
        out.append(
            "the camera with its lens cap on, 10 s (`--scene static`): what pixels at rest send is then seen "
            "without any scene"
        )
    # what is seen is found by the name of the signature, or of the effect that makes it
    certain = {one.effect for one in findings if one.grade is Grade.CERTAIN}
    out += [
        kind.without
        for kind in KINDS.values()
        if kind.without and not certain.isdisjoint((kind.name, *makers_of(kind.name, effects)))
    ]
    if not guessed and places.get("moving", 0.0) >= settings.much:
        out.append("steps and edges that are known exactly: `dase stimulus screen.mkv`, then `--stimulus`")
    return tuple(out)


def _better_frames(scene: Scene, settings: AdviceSettings) -> list[str]:
    """Return what frames would leave less to be guessed."""
    assert isinstance(scene, CameraScene)
    interval = float(np.median(np.diff(scene.times)))
    exposure = float(np.median(scene.end - scene.begin))
    out = [
        f"frames more often than every {format_metric(interval, 's')}, or slower motion: what happens "
        "between frames is a guess"
    ]
    if exposure > settings.blurred * interval:
        most = format_metric(settings.blurred * interval, "s")
        out.append(f"exposures below {most}, by more light: {format_metric(exposure, 's')} blur what moves")
    return out
