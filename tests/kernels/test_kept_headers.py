"""What Clang has read of Warp's headers passes from thread to thread and from process to process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import warp as wp

from dase.kernels import kept_headers, launch
from dase.kernels.vector_math import lane_options


def compile_and_run(factor: float) -> float:
    """Return 3 times a factor, by a kernel that nobody has compiled before."""

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def multiply(
        # in
        value: float,
        # out
        product_out: wp.array[float],  # (1,)
    ):
        product_out[0] = value * float(wp.static(factor))

    out = wp.zeros(1, dtype=float, device="cpu")
    wp.launch(multiply, dim=1, inputs=[3.0, out], device="cpu")
    return float(out.numpy()[0])


def folder_of_thread() -> Path:
    return Path(wp._src.context.runtime.get_clang_pch_dir())


def times_of(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


@pytest.fixture
def new_cache(tmp_path, monkeypatch) -> None:
    """An empty folder for compiled kernels."""
    launch.find_device("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))


def test_another_thread_takes_over_what_was_read(new_cache):
    assert compile_and_run(2.0) == 6.0
    folder_of_thread()  # Warp asks for it before the next kernel
    kept = set(times_of(kept_headers.kept_folder()))  # several where other flags were used before
    assert kept

    def in_new_thread() -> tuple[Path, dict[str, int], float, dict[str, int]]:
        mine = folder_of_thread()
        return mine, times_of(mine), compile_and_run(4.0), times_of(mine)

    with ThreadPoolExecutor(1) as pool:
        folder, before, product, after = pool.submit(in_new_thread).result()
    assert folder != folder_of_thread()
    assert product == 12.0
    assert set(before) == kept
    assert after == before  # nothing was read again


def test_a_damaged_file_is_not_lent(new_cache):
    kept = kept_headers.kept_folder()
    kept.mkdir()
    (kept / "damaged.pch").write_bytes(bytes(100))
    assert "damaged.pch" not in times_of(folder_of_thread())
    assert not (kept / "damaged.pch").exists()


def test_a_folder_that_cannot_be_written_keeps_nothing(new_cache, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "file"))
    assert not kept_headers.kept_folder().exists()
    assert folder_of_thread().is_dir()


def test_headers_of_another_setting_are_left_alone(new_cache, monkeypatch):
    mine = kept_headers.kept_folder()
    monkeypatch.setattr(wp._src.context, "_get_host_cpu_name", lambda: "another")
    assert kept_headers.kept_folder() != mine
