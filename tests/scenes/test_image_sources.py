"""Pictures: decoding, cutting out, determinism, COCO, and what bad input is told."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.call_counts import counting_calls

from dase.errors import InputError
from dase.scenes import image_sources
from dase.scenes.image_sources import ImageSource, Picture, open_images


def write(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.integers(0, 256, shape, dtype=np.uint8)


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator) -> Path:
    for i in range(5):
        write(tmp_path / "photos" / f"{i}.png", noise(rng, 60 + i, 90, 3))
    return tmp_path / "photos"


@pytest.fixture(params=["builtin", "folder"])
def source(request: pytest.FixtureRequest, folder: Path) -> ImageSource:
    return open_images("builtin" if request.param == "builtin" else str(folder))


def check(picture: Picture) -> None:
    for plane in (picture.grey, picture.alpha):
        if plane is not None:
            assert plane.dtype == np.float32
            assert plane.flags.writeable
            assert plane.flags.c_contiguous
            assert plane.shape == picture.grey.shape
            assert plane.min() >= 0
            assert plane.max() <= 1


def border(plane: np.ndarray) -> np.ndarray:
    return np.concatenate([plane[0], plane[-1], plane[:, 0], plane[:, -1]])


def test_backgrounds_are_opaque_pictures(source, rng):
    for _ in range(40):
        picture = source.background(rng)
        check(picture)
        assert picture.alpha is None
        assert min(picture.grey.shape) >= 60


def test_foregrounds_are_rectangles_or_tight_soft_cut_outs(source, rng):
    rectangles = 0
    for _ in range(100):
        picture = source.foreground(rng)
        check(picture)
        assert picture.alpha is not None
        if picture.alpha.min() == 1:
            rectangles += 1
            continue
        assert not border(picture.alpha).any()
        assert border(picture.alpha[1:-1, 1:-1]).any()
        for axis in (0, 1):  # tight on every side: the second row or column from the border is in use
            used = picture.alpha.any(axis)
            assert used[1:-1].all()
        assert picture.alpha.max() > 0.99
        assert 0.1 < picture.alpha.mean() < 0.9
        for axis in (0, 1):  # an edge two pixels soft
            assert np.abs(np.diff(picture.alpha, axis=axis)).max() < 0.55
    assert 15 < rectangles < 50


def test_same_random_numbers_give_the_same_pictures_whatever_came_before(source):
    def draw(seed: int) -> list[Picture]:
        rng = np.random.default_rng(seed)
        return [draw(rng) for draw in (source.foreground, source.background) for _ in range(12)]

    image_sources._read_picture.cache_clear()
    first = draw(3)
    draw(4)
    for picture in draw(3):  # scribbling on what was handed out must not reach the cache
        picture.grey.fill(0)
    for one, other in zip(first, draw(3), strict=True):
        np.testing.assert_array_equal(one.grey, other.grey)
        np.testing.assert_array_equal(one.alpha, other.alpha)
    assert any(not np.array_equal(a.grey, b.grey) for a, b in zip(first, draw(4), strict=True))


def test_cut_outs_carry_the_pixels_of_the_picture(rng):
    y, x = np.mgrid[:80, :120].astype(np.float32)
    grey = (y * 120 + x) / 9600  # every value names its place
    for _ in range(30):
        picture = image_sources.cut_random_shape(Picture(grey), rng)
        inside = picture.alpha > 0
        at = np.round(picture.grey * 9600).astype(int)
        rows, columns = np.nonzero(inside)
        np.testing.assert_array_equal(at[inside] // 120 - rows, at[inside][0] // 120 - rows[0])
        np.testing.assert_array_equal(at[inside] % 120 - columns, at[inside][0] % 120 - columns[0])


def test_grey_is_the_luma_of_s2r(tmp_path):
    blue, green, red = 40, 90, 200
    write(tmp_path / "a.png", np.full((20, 30, 3), (blue, green, red), np.uint8))
    grey = open_images(str(tmp_path)).background(np.random.default_rng(0)).grey
    np.testing.assert_allclose(grey, (0.21 * red + 0.72 * green + 0.07 * blue) / 255, atol=1e-6)


@pytest.mark.parametrize("suffix", ["png", "JPG", "bmp", "tif", "webp", "ppm", "pgm"])
def test_every_kind_of_file_is_read(tmp_path, suffix):
    write(
        tmp_path / "deep" / "er" / f"a.{suffix}", np.full((20, 30) + (3,) * (suffix != "pgm"), 51, np.uint8)
    )
    grey = open_images(str(tmp_path)).background(np.random.default_rng(0)).grey
    np.testing.assert_allclose(grey, np.full((20, 30), 0.2, np.float32), atol=0.005)


def test_sixteen_bits_are_scaled_and_kept(tmp_path):
    write(tmp_path / "a.png", np.full((20, 30), 12345, np.uint16))
    grey = open_images(str(tmp_path)).background(np.random.default_rng(0)).grey
    np.testing.assert_allclose(grey, 12345 / 65535, atol=1e-6)


def test_median_removes_a_single_bright_pixel(tmp_path):
    pixels = np.full((20, 30), 100, np.uint8)
    pixels[7, 9] = 255
    write(tmp_path / "a.png", pixels)
    grey = open_images(str(tmp_path)).background(np.random.default_rng(0)).grey
    np.testing.assert_allclose(grey, 100 / 255, atol=1e-6)


def test_large_pictures_are_shrunk(tmp_path, rng):
    write(tmp_path / "a.png", np.repeat(noise(rng, 1, 2100), 700, 0))
    picture = open_images(str(tmp_path)).background(rng)
    assert picture.grey.shape == (341, 1024)
    check(picture)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (5, 3)])
def test_tiny_pictures_give_rectangles(tmp_path, rng, shape):
    write(tmp_path / "a.png", noise(rng, *shape))
    source = open_images(str(tmp_path))
    for _ in range(10):
        picture = source.foreground(rng)
        check(picture)
        assert picture.alpha.min() == 1


def test_alpha_channel_is_the_cut_out(tmp_path, rng):
    pixels = np.zeros((50, 80, 4), np.uint8)
    pixels[..., :3] = 7  # hidden, must not be seen anywhere
    pixels[10:30, 20:60] = (200, 200, 200, 255)
    pixels[10:30, 59] = (200, 200, 200, 128)
    write(tmp_path / "a.png", pixels)
    source = open_images(str(tmp_path))
    picture = source.foreground(rng)
    want = np.zeros((22, 42), np.float32)
    want[1:-1, 1:-1] = 1
    want[1:-1, 40] = 128 / 255
    np.testing.assert_allclose(picture.alpha, want, atol=1e-6)
    np.testing.assert_allclose(picture.grey, 200 / 255, atol=1e-6)
    np.testing.assert_allclose(source.background(rng).grey, 200 / 255, atol=1e-6)


def test_full_alpha_channel_is_no_cut_out(tmp_path, rng):
    pixels = noise(rng, 50, 80, 4)
    pixels[..., 3] = 255
    write(tmp_path / "a.png", pixels)
    areas = {open_images(str(tmp_path)).foreground(rng).grey.shape for _ in range(10)}
    assert len(areas) > 5


def test_listing_is_sorted_and_leaves_out_what_is_no_picture(tmp_path, monkeypatch):
    rglob = Path.rglob
    monkeypatch.setattr(Path, "rglob", lambda path, what: sorted(rglob(path, what), reverse=True))
    for name in ("b/z.png", "a.jpg", "b.png", "C.PNG", ".hidden/x.png", "._a.jpg"):
        write(tmp_path / name, np.zeros((9, 9), np.uint8))
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "folder.png").mkdir()
    source = open_images(str(tmp_path))
    found = [path.relative_to(tmp_path).as_posix() for path in source._paths]
    assert found == ["C.PNG", "a.jpg", "b.png", "b/z.png"]
    assert len(source) == 4
    assert source.name == str(tmp_path)


def test_builtin_photographs_are_installed_and_a_quarter_is_drawn(rng):
    source = open_images("builtin")
    assert source.name == "builtin"
    for path in source._paths:
        assert image_sources._read_picture(path).grey.std() > 0.02, path
    sizes = [source.background(rng).grey.shape for _ in range(200)]
    drawn = sizes.count(image_sources.ImageSettings.drawn_size)
    assert 25 < drawn < 75


@pytest.mark.parametrize("kind", ["_fractal_noise", "_draw_grating", "_draw_polygons", "_draw_strokes"])
def test_textures_have_contrast_and_vary(kind, rng):
    one, other = (getattr(image_sources, kind)(rng, (384, 512)) for _ in range(2))
    for unit in (one, other):
        assert unit.shape == (384, 512)
        assert unit.min() >= 0
        assert unit.max() <= 1
        assert unit.std() > 0.05
    assert np.abs(one - other).mean() > 0.02


def test_photographs_of_a_real_folder(shared, rng):
    source = open_images(str(shared / "photos"))
    assert len(source) == 200
    for _ in range(20):
        check(source.foreground(rng))
        assert sorted(source.background(rng).grey.shape) == [321, 481]


# COCO


def coco(tmp_path: Path, **changes: Any) -> str:
    """Write one picture with a square instance and some that must be skipped; return the spec."""
    write(tmp_path / "pictures" / "a.png", np.full((100, 200), 51, np.uint8))
    square = [60, 20, 100, 20, 100, 60, 60, 60]  # 40 x 40 px
    content = {
        "images": [{"id": 4, "file_name": "a.png", "width": 200, "height": 100}],
        "annotations": [
            {"id": 1, "image_id": 4, "iscrowd": 0, "area": 1600, "segmentation": [square]},
            {"id": 2, "image_id": 4, "iscrowd": 1, "area": 9000, "segmentation": [square]},
            {"id": 3, "image_id": 4, "iscrowd": 0, "area": 399, "segmentation": [square]},
        ],
    } | changes
    (tmp_path / "instances.json").write_text(json.dumps(content))
    return f"coco:{tmp_path / 'instances.json'},{tmp_path / 'pictures'}"


def test_coco_instance_is_cut_out(tmp_path, rng, capfd):
    pytest.importorskip("pycocotools")
    spec = coco(tmp_path)
    source = open_images(spec)
    assert source.name == spec
    assert len(source) == 1
    assert len(source._instances) == 1
    picture = source.foreground(rng)
    check(picture)
    assert max(abs(n - 44) for n in picture.grey.shape) <= 1  # 40, a softened pixel and a border on each side
    assert abs(picture.alpha.sum() - 1600) < 90
    assert not border(picture.alpha).any()
    assert (picture.alpha[3:-3, 3:-3] == 1).all()
    assert source.background(rng).grey.shape == (100, 200)
    assert capfd.readouterr() == ("", "")


def test_coco_outline_is_shrunk_with_its_picture(tmp_path, rng):
    pytest.importorskip("pycocotools")
    spec = coco(
        tmp_path,
        images=[{"id": 4, "file_name": "a.png", "width": 2048, "height": 1000}],
        annotations=[{"id": 1, "image_id": 4, "area": 1e6, "segmentation": {"size": [1000, 2048]}}],
    )
    mask = np.zeros((1000, 2048), np.uint8)
    mask[:, 1024:] = 1
    content = json.loads((tmp_path / "instances.json").read_text())
    content["annotations"][0]["segmentation"]["counts"] = [1024 * 1000, 1024 * 1000]  # column by column
    (tmp_path / "instances.json").write_text(json.dumps(content))
    write(tmp_path / "pictures" / "a.png", mask * 255)
    picture = open_images(spec).foreground(rng)
    assert picture.alpha.shape == (502, 515)
    assert (picture.grey[picture.alpha == 1] > 0.99).all()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"annotations": []}, "must hold an instance.*found none among 0"),
        ({"annotations": [{"image_id": 4, "area": 90, "segmentation": [[1]]}]}, "found none among 1"),
        ({"annotations": [{"image_id": 5}]}, "must list images.*KeyError: 5"),
        ({"images": 3}, "must list images.*TypeError"),
        (
            {"images": [{"id": 4, "file_name": "b.png", "width": 9, "height": 9}]},
            "lacks 1 of 1, first 'b.png'",
        ),
        (  # more than a file system allows for a name
            {"images": [{"id": 4, "file_name": "b" * 300, "width": 9, "height": 9}]},
            "lacks 1 of 1, first 'bbbb",
        ),
    ],
)
def test_bad_annotations_are_refused(tmp_path, changes, said):
    pytest.importorskip("pycocotools")
    with pytest.raises(InputError, match=said):
        open_images(coco(tmp_path, **changes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"images": [{"id": 4, "file_name": "a.png", "width": 90, "height": 90}]},
            "size of the image.*90x90",
        ),
        (
            {"annotations": [{"id": 7, "image_id": 4, "area": 900, "segmentation": [[1]]}]},
            "annotation 7.*polygon",
        ),
        (
            {
                "annotations": [
                    {"id": 7, "image_id": 4, "area": 900, "segmentation": [[-9, -9, -8, -9, -8, -8]]}
                ]
            },
            "annotation 7.*enclose",
        ),
    ],
)
def test_bad_instances_are_refused_when_drawn(tmp_path, rng, changes, said):
    pytest.importorskip("pycocotools")
    source = open_images(coco(tmp_path, **changes))
    with pytest.raises(InputError, match=said):
        source.foreground(rng)


def test_bad_annotation_files_are_refused(tmp_path):
    pytest.importorskip("pycocotools")
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(InputError, match=r"broken.json' must be JSON"):
        open_images(f"coco:{tmp_path / 'broken.json'},{tmp_path}")
    with pytest.raises(InputError, match=r"cannot read annotations '.*none.json': No such file"):
        open_images(f"coco:{tmp_path / 'none.json'},{tmp_path}")
    with pytest.raises(InputError, match=r"folder '.*nowhere' is missing"):
        open_images(f"coco:{tmp_path / 'broken.json'},{tmp_path / 'nowhere'}")


@pytest.mark.parametrize("spec", ["coco:", "coco:a.json", "coco:a.json,", "coco:,dir"])
def test_coco_without_two_parts_is_refused(spec):
    with pytest.raises(InputError, match=r"coco:ANNOTATIONS.json,DIR.*got 'coco:"):
        open_images(spec)


def test_missing_pycocotools_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycocotools.coco", None)
    with pytest.raises(InputError, match=r'in the checkout of dase, pip install "\.\[coco\]"'):
        open_images(coco(tmp_path))


# Bad folders and files


def test_bad_folders_are_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("no picture")
    with pytest.raises(InputError, match=r"must hold a jpg, .* file, found none"):
        open_images(str(tmp_path))
    with pytest.raises(InputError, match=r"folder, '.*notes.txt' is a file"):
        open_images(str(tmp_path / "notes.txt"))
    with pytest.raises(InputError, match=r"'bulitin' is missing .*builtin"):
        open_images("bulitin")
    with pytest.raises(InputError, match="'' is missing"):
        open_images("")


@pytest.mark.parametrize("keep", [0, 5, 300])
def test_damaged_files_are_named_once(tmp_path, rng, capfd, keep):
    path = write(tmp_path / "half.png", noise(rng, 60, 60))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"cannot decode '.*half.png'"):
        open_images(str(tmp_path)).background(rng)
    assert "WARN" not in capfd.readouterr().err


def test_floating_point_files_are_refused(tmp_path, rng):
    write(tmp_path / "a.tif", np.ones((9, 9), np.float32))
    with pytest.raises(InputError, match=r"a.tif' must hold 8- or 16-bit values, holds float32"):
        open_images(str(tmp_path)).foreground(rng)


SQUARE = [10.0, 10.0, 50.0, 10.0, 50.0, 50.0, 10.0, 50.0]


def annotated(tmp_path, segmentation, **image):
    """One picture of 90x60 with an outline; fields of the picture may be others."""
    write(tmp_path / "pictures" / "a.png", noise(np.random.default_rng(0), 60, 90, 3))
    content = {
        "images": [{"id": 1, "file_name": "a.png", "width": 90, "height": 60, **image}],
        "annotations": [{"id": 7, "image_id": 1, "area": 1600, "iscrowd": 0, "segmentation": segmentation}],
    }
    (tmp_path / "instances.json").write_text(json.dumps(content))
    return f"coco:{tmp_path / 'instances.json'},{tmp_path / 'pictures'}"


def runs(mask):
    """Counts of a run-length code, column by column, as pycocotools packs them."""
    from pycocotools import mask as masks

    packed = masks.encode(np.asfortranarray(mask))
    return packed["counts"].decode()


@pytest.mark.parametrize(
    ("segmentation", "match"),
    [
        ([[1e300, 0, 5, 5, 9, 1e300]], "does not lie near"),
        ([[float("nan"), 0, 5, 5, 9, 9]], "does not lie near"),
        ([[float("inf"), 0, 5, 5, 9, 9]], "does not lie near"),
        ([[-(2**31), 0, 5, 5, 9, 9]], "does not lie near"),
        ([[10**400, 0, 5, 5, 9, 9]], "does not lie near"),
        ([["1", 0, 5, 5, 9, 9]], "does not lie near"),
        ([[1, 2, 3, 4]], "has 4 numbers"),
        ([[1, 2, 3, 4, 5, 6, 7]], "has 7 numbers"),
        ([SQUARE] * 200_000, "200000 polygons"),
        ([[1.0, 2.0] * 300_000], "1 polygons of 600000 numbers"),
        ([5], "neither a list of polygons"),
        ({"size": [60, 91], "counts": [0, 5460]}, "its size must be"),
        ({"size": [60, 90], "counts": [0, 5401]}, "add up to 5400"),
        ({"size": [60, 90], "counts": [-1, 5401]}, "whole numbers >= 0"),
        ({"size": [60, 90], "counts": "zzzzzzzzzzzzzzzzz"}, "no compressed"),
        ({"size": [60, 90], "counts": "\u0001"}, "no compressed"),
        ({"size": [60, 90], "counts": "PP0"}, "counts must"),
        ({"size": [60, 90]}, "counts must"),
    ],
)  # fmt: skip
def test_coco_outlines_that_would_crash_are_refused(tmp_path, rng, segmentation, match):
    pytest.importorskip("pycocotools")
    source = open_images(annotated(tmp_path, segmentation))
    with counting_calls() as counted, pytest.raises(InputError, match=rf"annotation 7 of 'a.png'.*{match}"):
        source.foreground(rng)
    assert counted.calls < 2_000_000


def test_coco_outlines_of_every_kind_are_cut_out(tmp_path, rng):
    pytest.importorskip("pycocotools")
    mask = np.zeros((60, 90), np.uint8)
    mask[10:50, 10:50] = 1
    mask[20:25, 60:80] = mask[59, 89] = 1
    flat = mask.ravel(order="F")
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flat)))).tolist()
    plain = np.diff([0, *edges, flat.size]).tolist()
    for segmentation in (
        [SQUARE],
        {"size": [60, 90], "counts": plain},
        {"size": [60, 90], "counts": runs(mask)},
    ):
        picture = open_images(annotated(tmp_path, segmentation)).foreground(rng)
        assert picture.grey.shape[0] >= 40
    assert image_sources._unpacked_runs(runs(mask)) == plain


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../a.png",
        "b/../../a.png",
        "C:\\a.png",
        "..\\a.png",
        "\\\\host\\a.png",
        "",
        "a\0.png",
        5,
        "a" * 30_000 + ".png",  # refused by the file system with an error of its own, as is the next
        "a" * 300 + ".png",
    ],
)
def test_coco_names_that_lead_out_are_refused(tmp_path, name):
    pytest.importorskip("pycocotools")
    write(tmp_path / "a.png", noise(np.random.default_rng(0), 60, 90, 3))
    with pytest.raises(InputError, match=r"leads out of the folder|must name files|lacks 1 of 1") as found:
        open_images(annotated(tmp_path, [SQUARE], file_name=name))
    assert len(str(found.value)) < 1000


def test_a_coco_width_without_end_is_refused(tmp_path):
    pytest.importorskip("pycocotools")
    with pytest.raises(InputError, match=r"width of 'a\.png' must be a whole number"):
        open_images(annotated(tmp_path, [SQUARE], width=10**400))


@pytest.mark.parametrize(
    "size", [{"width": 2**31}, {"width": 32768, "height": 32768}, {"width": 1.5}, {"height": 0}]
)
def test_coco_sizes_that_are_none(tmp_path, size):
    pytest.importorskip("pycocotools")
    with pytest.raises(InputError, match=r"must be a whole number|million pixels"):
        open_images(annotated(tmp_path, [SQUARE], **size))


def test_deeply_nested_annotations(tmp_path):
    pytest.importorskip("pycocotools")
    (tmp_path / "deep.json").write_text('{"images": ' + "[" * 200_000 + "]" * 200_000 + "}")
    with pytest.raises(InputError, match="nested too deeply"):
        open_images(f"coco:{tmp_path / 'deep.json'},{tmp_path}")
