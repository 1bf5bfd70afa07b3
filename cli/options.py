"""Values of options that several commands take."""

from __future__ import annotations

import click


def parse_size(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Return (columns, rows) of a text such as 640x480."""
    if value is None:
        return None
    try:
        width, height = (int(part) for part in value.lower().split("x"))
    except ValueError:
        raise click.BadParameter(f"{value!r} is not of the form WxH, such as 640x480") from None
    if width < 1 or height < 1 or max(width, height) > 16384:
        raise click.BadParameter(f"{value!r} must lie between 1x1 and 16384x16384")
    return width, height
