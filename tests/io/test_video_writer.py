"""Videos that are written."""

from __future__ import annotations

import subprocess
import sys

FIRST_USE = """
import sys
from pathlib import Path
from dase.io.video_writer import VideoCodec, open_video_writer

writer, codec = open_video_writer(Path(sys.argv[1]), 30, (64, 48), [VideoCodec("avc1"), VideoCodec("mp4v")])
assert writer is not None
print(codec.letters)
"""


def test_a_codec_that_is_missing_is_no_news(tmp_path):
    # in a process of its own: OpenCV asks how much FFmpeg may say where it is used for the first time
    made = subprocess.run(
        [sys.executable, "-c", FIRST_USE, str(tmp_path / "a.mp4")], capture_output=True, text=True, check=True
    )
    assert made.stdout.strip() in ("avc1", "mp4v")
    assert made.stderr == ""
