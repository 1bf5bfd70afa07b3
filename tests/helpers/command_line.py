"""The command line as a user meets it: a process of its own, and what it says when something is wrong."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from unittest.mock import patch

from dase.cli import main

SMALL = ("--size", "32x24", "--duration", "0.1", "--sequences", "1", "--jobs", "1", "--regime", "slow")


def dase(*arguments: object, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from dase.cli import main; main()", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)


def one_sentence(done: subprocess.CompletedProcess[str], code: int = 2) -> str:
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    said = [line for line in done.stderr.splitlines() if not re.match(r"Usage:|Try |$", line)]
    assert len(said) == 1, done.stderr
    return said[0]


def dase_here(*arguments: object, cwd: object = ".") -> subprocess.CompletedProcess[str]:
    """Return what a command says; it runs in this process, which saves the two seconds of its imports."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    command = ["dase", *map(str, arguments)]
    with (
        patch.object(sys, "argv", command),
        redirect_stdout(out),
        redirect_stderr(err),
        chdir(str(cwd)),
    ):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


def refusal(*arguments: object, cwd: object = ".") -> str:
    """Return the one sentence with which a command ends."""
    return one_sentence(dase_here(*arguments, cwd=cwd))
