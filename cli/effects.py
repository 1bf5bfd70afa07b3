"""What the sensor's effects are, and how to begin one of your own."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import check_output, effects_option


@click.group()
def effects_command() -> None:
    """List the physical effects, describe one, or begin one of your own."""


@effects_command.command("list")
@effects_option
def list_effects(effects: tuple[Path, ...]) -> None:
    """List all effects, in the order in which they act."""
    from dase.simulation.user_effects import known_effects

    known = known_effects(effects)
    width = max(map(len, known))
    for name, effect in known.items():
        click.echo(f"{name:{width}}  {effect.about().splitlines()[0]}")


@effects_command.command("show")
@click.argument("name")
@effects_option
def show_effect(name: str, effects: tuple[Path, ...]) -> None:
    """Describe the effect NAME: physics, parameters, signatures, source."""
    from dase.effects import SceneEffect, StreamEffect, find_effect
    from dase.signatures.kinds import KINDS
    from dase.simulation.user_effects import known_effects

    effect = find_effect(name, known_effects(effects))
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
    for one in effect.signatures or ():
        click.echo(f"Signature: {one.signature}, that is, {KINDS[one.signature].about}")
    click.echo(f"Source: {effect.source}")


@effects_command.command("new")
@click.argument("name")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    callback=check_output,
    help="Python file.  [default: NAME.py]",
)
def new_effect(name: str, output: Path | None) -> None:
    """Write a Python file with a new effect NAME to fill in. It works as it is."""
    from dase.simulation import effect_template

    output = output or Path(f"{name}.py")
    effect_template.new_effect(name, output)
    click.echo(f"{output} written: put your physics into it. Try it:")
    for line in effect_template.trial_commands(name, str(output)):
        click.echo(f"    {line}")
