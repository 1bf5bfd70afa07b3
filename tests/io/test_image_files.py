"""Picture files: sizes are looked at before anything is decoded, and values as grey levels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dase.errors import InputError
from dase.io import image_files
from dase.io.image_files import decode_file, head_size


@pytest.mark.parametrize("suffix", ["png", "tif", "webp", "jpg"])
def test_small_files_of_huge_pictures_are_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    options = [cv2.IMWRITE_TIFF_COMPRESSION, 8] if suffix == "tif" else []  # deflate
    assert cv2.imwrite(str(path), np.zeros((7000, 7000), np.uint8), options)
    with pytest.raises(
        InputError, match=r"cannot decode '.*a\.\w+': a picture of 7000x7000 unpacks .*100 times"
    ):
        decode_file(path)


def test_pictures_of_16_bits_and_three_colours_are_read(tmp_path, rng):
    """Pillow has no name for such a TIFF, but its head tells the size."""
    pixels = rng.integers(0, 1 << 16, (6, 8, 3), np.uint16)
    for suffix in ("tif", "png"):
        cv2.imwrite(str(tmp_path / f"a.{suffix}"), pixels)
        np.testing.assert_array_equal(decode_file(tmp_path / f"a.{suffix}"), pixels)
        assert head_size((tmp_path / f"a.{suffix}").read_bytes()) == (8, 6)


def test_levels_are_the_rounded_grey_values(rng, monkeypatch):
    monkeypatch.setattr(image_files, "BAND", 40)  # some rows at once, the last ones fewer
    for kind, channels in ((np.uint8, 3), (np.uint8, 4), (np.uint16, 1), (np.uint16, 3)):
        pixels = rng.integers(0, np.iinfo(kind).max, (23, 9, channels), kind, endpoint=True)
        blue, green, red = (pixels[..., min(k, channels - 1)].astype(np.float64) for k in range(3))
        grey = (0.07 * blue + 0.72 * green + 0.21 * red) / np.iinfo(kind).max
        np.testing.assert_allclose(image_files.to_grey(pixels)[0], grey, atol=1e-6)
        assert np.abs(image_files.to_levels(pixels) - 255 * grey).max() < 0.5 + 1e-3
