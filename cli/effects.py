"""What the sensor's effects are."""

from __future__ import annotations

import click


@click.group()
def command() -> None:
    """List the physical effects, or describe one."""


@command.command("list")
def list_effects() -> None:
    """List all effects, in the order in which they act."""
    from dase.effects import EFFECTS

    width = max(map(len, EFFECTS))
    for name, effect in EFFECTS.items():
        click.echo(f"{name:{width}}  {effect.about().splitlines()[0]}")


@command.command("show")
@click.argument("name")
def show_effect(name: str) -> None:
    """Describe the effect NAME: physics, parameters, source."""
    from dase.effects import SceneEffect, StreamEffect, find

    effect = find(name)
    click.echo(f"{effect.name}: {effect.about()}\n")
    for p in effect.parameters():
        low, high = p.plausible
        off = "" if p.off is None else f", off at {p.off:g}"
        unit = "" if p.unit == "1" else f" {p.unit}"
        click.echo(f"  {p.name} = {p.default:g}{unit}  {p.about}")
        click.echo(f"      {p.bounds[0]:g} to {p.bounds[1]:g}, plausible {low:g} to {high:g}{off}")
    for name, among in effect.choices().items():
        click.echo(f"  {name}: {' or '.join(among)}")
    places = {SceneEffect: "optics, before the pixels", StreamEffect: "readout"}
    elsewhere = [place for kind, place in places.items() if issubclass(effect, kind)]
    stages = effect.stages or elsewhere or ["core of the change detector"]
    click.echo(f"\nStages: {', '.join(stages)}")
    click.echo(f"Source: {effect.source}")
