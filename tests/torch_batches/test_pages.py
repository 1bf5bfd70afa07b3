"""The examples of the README and of docs/training-batches.md, word for word."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("torch")

ROOT = Path(__file__).parents[2]


def blocks(page: str) -> list[str]:
    text = (ROOT / page).read_text("utf-8")
    return [
        code for code in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL) if "torch.Stream" in code
    ]


@pytest.mark.parametrize(("page", "number"), [("README.md", 0), ("docs/training-batches.md", 0)])
def test_streams(page, number):
    scope: dict = {}
    exec(compile(blocks(page)[number], page, "exec"), scope)
    assert scope["batch"].inputs.shape == (8, 4, 5, 128, 128)
    assert scope["batch"].inputs.any()


@pytest.mark.slow
def test_a_loader(tmp_path):
    """Spawned processes import the script again, hence a file."""
    import subprocess
    import sys

    (code,) = (block for block in blocks("docs/training-batches.md") if "DataLoader" in block)
    head, loop = code.split("stream =")
    body = "".join(f"    {line}\n" for line in f"stream ={loop}".splitlines())
    script = tmp_path / "script.py"
    script.write_text(f'{head}if __name__ == "__main__":\n{body}')
    done = subprocess.run(
        [sys.executable, str(script)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("tensor(")
