"""The `dase` command. Each command is a file with a click command `NAME_command`, loaded when it is run."""

from __future__ import annotations

import errno
import importlib
import os
import sys
from typing import Any

import click

if __name__ != "dase.cli":
    raise ImportError("import dase.cli, not cli")

COMMANDS = (
    "add",
    "bias",
    "compare",
    "convert",
    "demo",
    "diagnose",
    "distinguish",
    "effects",
    "evaluate",
    "fit",
    "info",
    "presets",
    "remove",
    "show",
    "stimulus",
    "synth",
    "train",
)


class PrintableStream:
    """A text stream that shows characters which would steer a terminal, instead of sending them.

    Args:
        stream: Where the text goes.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text; return how many of its characters were taken, all."""
        from dase.errors import printable

        self._stream.write(printable(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class LazyGroup(click.Group):
    """A group that imports a command's file when the command is named, so that `--help` answers at once."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; what it prints cannot steer the terminal, whatever names and texts of files hold."""
        shown = sys.stdout
        sys.stdout = PrintableStream(shown)
        try:
            return super().invoke(ctx)
        finally:
            sys.stdout = shown

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of this name."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(
            importlib.import_module(f"dase.cli.{cmd_name}"), f"{cmd_name}_command"
        )
        return command


def print_version(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Print the version and exit."""
    if value and not ctx.resilient_parsing:
        from importlib.metadata import version as installed

        click.echo(f"dase {installed('dase')}")
        ctx.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=print_version,
    help="Print the version.",
)
def dase_group() -> None:
    """Simulate event cameras: exact, fast, and like yours."""


def main() -> None:
    """Run the command line.

    Wrong input is one sentence and exit code 2; an interrupt is exit code 130, SIGTERM 143, SIGHUP 129.
    """
    _open_closed_streams()
    from dase.errors import InputError
    from dase.files.interrupt import Terminated, raising_signals

    try:
        with raising_signals():
            code = dase_group.main(standalone_mode=False)
    except Terminated as signalled:
        _exit_with(f"ended by {signalled}", 128 + signalled.number)
    except click.exceptions.Abort:
        _exit_with("interrupted", 130)
    except KeyboardInterrupt:
        _exit_with("interrupted", 130)
    except click.ClickException as error:
        shown: Any = PrintableStream(sys.stderr)  # words of the command line may be names of files
        error.show(file=shown)
        sys.exit(error.exit_code)
    except InputError as error:
        _exit_with(f"{error} (--{error.argument})" if error.argument else str(error), 2)
    except MemoryError as error:
        _exit_with(f"not enough memory: {error}" if str(error) else "not enough memory", 2)
    except BrokenPipeError:
        # the reader of our output has gone; nothing is left to say to it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        reason = (
            "no space left on the disk" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        )
        if error.filename and _is_of_kernel_cache(str(error.filename)):
            reason += ": compiled kernels cannot be kept there; WARP_CACHE_PATH names another folder"
        _exit_with(f"{error.filename}: {reason}" if error.filename else reason, 2)
    sys.exit(code if isinstance(code, int) else 0)


def _open_closed_streams() -> None:
    """Give standard streams that the caller has closed to the null device, like any that nobody reads.

    Else the next file that is opened would get their number, and what is printed would go into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))


def _is_of_kernel_cache(name: str) -> bool:
    """Whether a path is in the folder of compiled kernels, or above it."""
    warp = sys.modules.get("warp")
    place = (warp and warp.config.kernel_cache_dir) or os.environ.get("WARP_CACHE_PATH")
    if not place:
        return False
    one, other = os.path.realpath(name), os.path.realpath(place)
    return os.path.commonpath([one, other]) in (one, other)


def _exit_with(message: str, code: int) -> None:
    from dase.errors import printable

    click.echo(f"dase: {printable(message)}", err=True)
    sys.exit(code)
