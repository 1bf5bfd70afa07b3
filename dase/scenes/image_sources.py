"""Pictures to make scenes of: photographs that come along, a folder, or the instances of COCO."""

from __future__ import annotations

import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError, checked_integer, how_to_install
from dase.files.text_files import parse_json, stands_for
from dase.io.image_files import SUFFIXES, decode_file, list_pictures, to_colour, to_grey

# fmt: off
PHOTOGRAPHS = (  # inside the wheel of scikit-image; its other files are silhouettes, charts and duplicates
    "astronaut.png", "brick.png", "camera.png", "chelsea.png", "coffee.png", "coins.png", "grass.png",
    "gravel.png", "hubble_deep_field.jpg", "ihc.png", "moon.png", "motorcycle_left.png", "retina.jpg",
    "rocket.jpg", "text.png",
)
# fmt: on
Grey = NDArray[np.float32]
WHOLE = slice(None), slice(None)
"""Rows and columns of a picture as a whole."""
BACKGROUND = (320, 480)
"""Rows and columns of the backgrounds of a pool [texel]: its kernels want one size."""


@dataclass(frozen=True)
class ImageSettings:
    """What becomes of picture files, and what is drawn and cut from them."""

    longest_side: int = 1024
    """Larger pictures are shrunk to this [px]: sensors have seldom more columns."""
    drawn_share: float = 0.25
    """Share of procedural textures among the built-in pictures."""
    drawn_size: tuple[int, int] = (384, 512)
    """Rows and columns of a procedural texture [px]."""
    smallest_cut: int = 16
    """No side of a crop is shorter [px], unless the picture is."""
    coco_share: float = 0.005
    """Share of its picture that an instance must cover."""
    coco_area: int = 400
    """Pixels that an instance must cover."""
    most_polygons: int = 2000
    """Polygons of one outline; those of COCO have below 50."""
    most_numbers: int = 400_000
    """Numbers of all polygons of one outline; those of COCO have below 10 000."""
    most_pixels: int = 200_000_000
    """Pixels of a picture that is annotated: its outlines are drawn so large."""


@dataclass(frozen=True)
class Picture:
    """A texture.

    Args:
        grey: Intensity in [0, 1], float32, shape (H, W).
        alpha: Opacity in [0, 1], float32, shape (H, W); None is opaque.
        colour: Intensity of red, green and blue in [0, 1], float32, shape (3, H, W), of which `grey` is the
            luma; None where all three are `grey`.
    """

    grey: Grey
    alpha: Grey | None = None
    colour: NDArray[np.float32] | None = None

    def cut(self, box: tuple[slice, slice]) -> Picture:
        """Return the rows and columns of a box, opaque, as arrays of their own."""
        colour = None if self.colour is None else self.colour[:, *box].copy()
        return Picture(self.grey[box].copy(), None, colour)

    def filtered(self, colour: int, purity: float) -> Picture:
        """Return the picture in red (0), green (1) or blue (2) light, see `Scene.filtered`."""
        if self.colour is None:
            return self
        # where a colour is the grey, it stays so to the bit
        grey = self.grey + np.float32(purity) * (self.colour[colour] - self.grey)
        return Picture(grey, self.alpha)


class ImageSource(ABC):
    """Pictures to make scenes of; what is drawn depends on the random numbers alone.

    Args:
        name: What `open_images` was given; goes into the configuration.
    """

    name: str

    @abstractmethod
    def __len__(self) -> int:
        """Number of picture files to draw from."""

    @abstractmethod
    def background(self, rng: np.random.Generator) -> Picture:
        """Draw a whole picture, opaque; raises InputError for a file that cannot be read."""

    @abstractmethod
    def foreground(self, rng: np.random.Generator) -> Picture:
        """Draw an object with alpha, cropped tightly; raises InputError for a file that cannot be read.

        The outermost pixels of an outlined object have alpha 0, so that interpolation fades out.
        A rectangle has alpha 1 up to its sharp border.
        """


def open_images(spec: str, *, colour: bool = False) -> ImageSource:
    """Open a source of pictures.

    Args:
        spec: "builtin"; a folder, searched recursively; or "coco:ANNOTATIONS.json,DIR", split at the last
            comma, which needs the extra `coco`.
        colour: Whether pictures carry their colours, which take three times the memory again. The same
            random numbers draw the same pictures, with the same grey.

    Raises:
        InputError: The folder or the annotations are missing or hold nothing to draw.
    """
    if spec == "builtin":
        package = find_spec("skimage")
        folder = Path(package.origin if package and package.origin else "skimage").parent / "data"
        files = [folder / name for name in PHOTOGRAPHS]
        return FolderImages(spec, files, drawn_share=ImageSettings.drawn_share, colour=colour)
    if spec.startswith("coco:"):
        annotations, _, directory = spec.removeprefix("coco:").rpartition(",")
        if not annotations or not directory:
            raise InputError(f"images: write coco:ANNOTATIONS.json,DIR with one comma between, got '{spec}'")
        return CocoImages(spec, Path(annotations), _existing_folder(directory), colour=colour)
    found = list_pictures(_existing_folder(spec))
    if not found:
        raise InputError(f"images: folder '{spec}' must hold a {', '.join(SUFFIXES)} file, found none")
    return FolderImages(spec, found, colour=colour)


class FolderImages(ImageSource):
    """Picture files, drawn uniformly, and optionally procedural textures.

    A file with a cut-out in its alpha channel gives that as foreground; from any other a rectangle, a blob,
    an ellipse or a polygon is cut.

    Args:
        name: What `open_images` was given.
        paths: The files; they are decoded when they are drawn.
        drawn_share: Share of procedural textures in [0, 1], which are grey.
        colour: Whether pictures carry their colours.
    """

    def __init__(self, name: str, paths: Sequence[Path], *, drawn_share: float = 0.0, colour: bool = False):
        self.name = name
        self._paths = paths
        self._drawn_share = drawn_share
        self._colour = colour

    def __len__(self) -> int:
        return len(self._paths)

    def background(self, rng: np.random.Generator) -> Picture:
        """Draw a whole picture; what its alpha channel hides has the mean grey of what it shows."""
        return self._draw(rng).cut(WHOLE)

    def foreground(self, rng: np.random.Generator) -> Picture:
        """Draw the cut-out of a file, or cut a shape from it."""
        picture = self._draw(rng)
        if picture.alpha is None:
            return cut_random_shape(picture, rng)
        return _crop_to_alpha(picture, picture.alpha)

    def _draw(self, rng: np.random.Generator) -> Picture:
        if rng.random() < self._drawn_share:
            return Picture(draw_texture(rng))
        return _read_picture(self._paths[int(rng.integers(len(self._paths)))], self._colour)


class CocoImages(ImageSource):
    """Photographs with outlined objects, annotated as COCO instances (Lin et al., Microsoft COCO, 2014).

    Foregrounds are instances, drawn uniformly, without crowds and tiny ones; backgrounds are whole images.

    Args:
        name: What `open_images` was given.
        annotations: JSON file with `images` and `annotations`.
        directory: Folder of the images.
        colour: Whether pictures carry their colours.

    Raises:
        InputError: A file is missing or the annotations hold no usable instance.
    """

    def __init__(self, name: str, annotations: Path, directory: Path, *, colour: bool = False):
        try:
            from pycocotools.coco import COCO
        except ImportError:
            raise InputError(f"images: coco: needs pycocotools: {how_to_install('coco')}") from None
        self.name = name
        self._file, self._folder, self._colour = annotations, directory, colour
        images, instances = _read_annotations(annotations)
        self._images, self._instances = list(images.values()), instances
        # not `Path.is_file`, to which a name can be too long
        missing = [i["file_name"] for i in self._images if not os.path.isfile(directory / i["file_name"])]
        if missing:
            raise InputError(
                f"images: '{directory}' must hold every image that '{annotations}' lists, "
                f"lacks {len(missing)} of {len(images)}, first '{missing[0][:100]}'"
            )
        self._coco = COCO()  # given a file, it would print; an outline needs nothing but the image sizes
        self._coco.imgs = images

    def __len__(self) -> int:
        return len(self._images)

    def background(self, rng: np.random.Generator) -> Picture:
        """Draw a whole image."""
        image = self._images[rng.integers(len(self._images))]
        return _read_picture(self._folder / image["file_name"], self._colour).cut(WHOLE)

    def foreground(self, rng: np.random.Generator) -> Picture:
        """Draw an instance; raises InputError if its outline does not fit its image."""
        instance = self._instances[rng.integers(len(self._instances))]
        image = self._coco.imgs[instance["image_id"]]
        picture = _read_picture(self._folder / image["file_name"], self._colour)
        grey = picture.grey
        what = f"images: '{self._file}': annotation {instance.get('id')} of '{image['file_name']}'"
        size = image["width"], image["height"]
        if _shrunk_size(*size) != grey.shape[::-1]:
            raise InputError(f"{what} must have the size of the image file, got {size[0]}x{size[1]}")
        try:
            check_outline(instance["segmentation"], *size)
        except InputError as error:
            raise InputError(f"{what} must be a polygon or a run-length code: {error}") from None
        try:
            with warnings.catch_warnings(action="ignore"):  # pycocotools 2.0.11 warns with NumPy 2
                mask = np.asarray(self._coco.annToMask(instance), np.float32)
        except Exception as error:  # pycocotools raises what it likes, bare Exceptions too
            raise InputError(f"{what} must be a polygon or a run-length code: {error}") from error
        if not mask.any():
            raise InputError(f"{what} must enclose a pixel, encloses none")
        mask = cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_AREA)
        return _crop_to_alpha(picture, cv2.GaussianBlur(mask, (3, 3), 0))


def _read_annotations(path: Path) -> tuple[dict[int, dict[str, Any]], list[dict[str, Any]]]:
    """Return the images by their id and the instances worth cutting out."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"images: cannot read annotations '{path}': {error.strerror}") from error
    pointer = stands_for(data[:1024])
    if pointer:
        raise InputError(f"images: annotations '{path}' {pointer}")
    content = parse_json(data, f"images: annotations '{path}'")
    try:
        images = {image["id"]: image for image in content["images"]}
        for image in images.values():
            _check_file_name(image["file_name"], path)
            _check_image_size(image, path)
        instances = [a for a in content["annotations"] if _is_usable_instance(a, images[a["image_id"]])]
    except (KeyError, TypeError) as error:
        raise InputError(
            f"images: annotations '{path}' must list images (id, file_name, width, height) and annotations "
            f"(image_id, area, segmentation), as COCO instances do; {type(error).__name__}: {error}"
        ) from error
    if not instances:
        raise InputError(
            f"images: annotations '{path}' must hold an instance, not a crowd, "
            f"of at least {ImageSettings.coco_area} px "
            f"and {ImageSettings.coco_share:.1%} of its image, found none among {len(content['annotations'])}"
        )
    return images, instances


def _check_file_name(name: Any, annotations: Path) -> None:
    """Raise InputError where the name of a picture leads out of the folder of pictures."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"images: annotations '{annotations}' must name files, got {repr(name)[:100]}")
    for kind in (PurePosixPath, PureWindowsPath):
        parts = kind(name)
        if parts.is_absolute() or parts.drive or ".." in parts.parts:
            raise InputError(
                f"images: annotations '{annotations}' name '{name}', which leads out of the folder"
            )


def _check_image_size(image: dict[str, Any], annotations: Path) -> None:
    """Raise InputError where a picture claims a size that none has: its outlines are drawn so large."""
    for name in ("width", "height"):
        checked_integer(f"images: '{annotations}': {name} of '{image['file_name']}'", image[name], 1, 1 << 15)
    if image["width"] * image["height"] > ImageSettings.most_pixels:
        raise InputError(
            f"images: '{annotations}': '{image['file_name']}' claims {image['width']}x{image['height']}, "
            f"more than {ImageSettings.most_pixels / 1e6:.0f} million pixels"
        )


def check_outline(outline: Any, width: int, height: int) -> None:
    """Raise InputError where an outline is not one that pycocotools can take: it crashes on others.

    Args:
        outline: Polygons as lists x, y, x, y, ...; or a run-length code, a table of size [rows, columns] and
            counts, a list or a compressed text.
        width: Columns of the picture.
        height: Rows of the picture.
    """
    if isinstance(outline, dict):
        _check_runs(outline, width, height)
        return
    if not isinstance(outline, list) or not all(isinstance(polygon, list) for polygon in outline):
        raise InputError("it is neither a list of polygons nor a table")
    numbers = sum(len(polygon) for polygon in outline)
    if len(outline) > ImageSettings.most_polygons or numbers > ImageSettings.most_numbers:
        raise InputError(
            f"it has {len(outline)} polygons of {numbers} numbers, "
            f"at most {ImageSettings.most_polygons} of {ImageSettings.most_numbers} are read"
        )
    reach = 2 * max(width, height)
    for polygon in outline:
        if len(polygon) < 6 or len(polygon) % 2:
            raise InputError(
                f"a polygon has {len(polygon)} numbers; at least 6, and two for a corner, are needed"
            )
        if not all(type(value) in (int, float) and abs(value) <= reach for value in polygon):
            raise InputError(f"a corner of a polygon does not lie near the {width}x{height} picture")


def _check_runs(outline: dict[str, Any], width: int, height: int) -> None:
    if outline.get("size") != [height, width]:
        raise InputError(f"its size must be [{height}, {width}], got {outline.get('size')!r}")
    counts = outline.get("counts")
    if isinstance(counts, str):
        counts = _unpacked_runs(counts)
    if not isinstance(counts, list) or not all(type(count) is int and count >= 0 for count in counts):
        raise InputError("its counts must be whole numbers >= 0")
    if sum(counts) != width * height:
        raise InputError(f"its counts must add up to {width * height} pixels, not {sum(counts)}")


def _unpacked_runs(text: str) -> list[int]:
    """Return the counts of a compressed run-length code: 5 bits a letter from '0' on, bit 5: more follow."""
    out: list[int] = []
    value = shift = 0
    for letter in text:
        bits = ord(letter) - 48
        if not 0 <= bits < 64 or shift > 25:
            raise InputError("its counts are no compressed run-length code")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        # from the fourth on, each is told as the difference to the one before the last
        out.append(value + (out[-2] if len(out) > 2 else 0))
        value = shift = 0
    if shift:
        raise InputError("its counts are no compressed run-length code")
    return out


def _is_usable_instance(instance: dict[str, Any], image: dict[str, Any]) -> bool:
    least = max(ImageSettings.coco_area, ImageSettings.coco_share * image["width"] * image["height"])
    return bool(instance.get("segmentation")) and not instance.get("iscrowd") and instance["area"] >= least


def _existing_folder(name: str) -> Path:
    if not os.path.exists(name):
        raise InputError(f"images: folder '{name}' is missing (or write builtin, or coco:FILE.json,DIR)")
    if not os.path.isdir(name):
        raise InputError(f"images: must be a folder, '{name}' is a file")
    return Path(name)


@lru_cache(maxsize=64)  # per process: at most 4 MiB each, 8 MiB with alpha, 12 MiB more with colour
def _read_picture(path: Path, with_colour: bool = False) -> Picture:
    """Decode, grey, shrink and median-filter a file; the arrays are shared, hence read-only."""
    pixels = decode_file(path)
    grey, alpha = to_grey(pixels)
    colour = to_colour(pixels, grey) if with_colour else None
    planes = [grey] if colour is None else [grey, *colour]
    size = _shrunk_size(*grey.shape[::-1])
    for n, plane in enumerate(planes):
        if alpha is not None and (alpha > 0).any():
            # what is hidden must not leak into edges and backgrounds
            plane[alpha == 0] = plane[alpha > 0].mean()
        plane = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
        planes[n] = cv2.medianBlur(np.clip(plane, 0, 1), 3)
        planes[n].flags.writeable = False
    grey, colour = planes[0], np.stack(planes[1:]) if len(planes) > 1 else None
    if colour is not None:
        colour.flags.writeable = False
    alpha = None if alpha is None else cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)
    if alpha is None or not 0.005 < float((alpha > 0.5).mean()) < 0.995:
        # an alpha channel that shows or hides everything is no cut-out
        return Picture(grey, None, colour)
    alpha.flags.writeable = False
    return Picture(grey, alpha, colour)


def _shrunk_size(width: int, height: int, longest: int = ImageSettings.longest_side) -> tuple[int, int]:
    """Return width and height of a picture after shrinking."""
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _crop_to_alpha(picture: Picture, alpha: Grey) -> Picture:
    """Crop to alpha > 0 and put a border of alpha 0 around."""
    rows, columns = (np.flatnonzero((alpha > 0).any(axis)) for axis in (1, 0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    part = picture.cut(box)
    colour = None if part.colour is None else np.pad(part.colour, ((0, 0), (1, 1), (1, 1)), mode="edge")
    return Picture(np.pad(part.grey, 1, mode="edge"), np.clip(np.pad(alpha[box], 1), 0, 1), colour)


def cut_random_shape(
    picture: Picture, rng: np.random.Generator, smallest: int = ImageSettings.smallest_cut
) -> Picture:
    """Cut a random shape from a random place of a picture.

    Three in ten are rectangles, as many blobs; the rest are ellipses and polygons, with an edge 2 px soft.

    Args:
        picture: Its alpha does not matter.
        rng: Random numbers.
        smallest: No side of the shape's box is shorter, unless the picture is [px].
    """
    shape = picture.grey.shape
    sides = [max(min(n, smallest), round(n * rng.uniform(0.3, 1))) for n in shape]
    top, left = (int(rng.integers(n - side + 1)) for n, side in zip(shape, sides, strict=True))
    part = picture.cut((slice(top, top + sides[0]), slice(left, left + sides[1])))
    kind = rng.choice(4, p=(0.3, 0.3, 0.2, 0.2))
    if kind == 0 or min(sides) < smallest:
        return replace(part, alpha=np.ones_like(part.grey))
    outline = (_blob_outline, _ellipse_outline, _polygon_outline)[kind - 1](rng)
    mask = np.zeros(part.grey.shape, np.uint8)
    _fill_polygon(mask, 2.0 + outline * np.subtract(mask.shape[::-1], 5), 255)  # 2 px for the soft edge
    return _crop_to_alpha(part, cv2.GaussianBlur(mask, (3, 3), 0) / np.float32(255))


def _blob_outline(rng: np.random.Generator) -> NDArray[np.float64]:
    """Star-convex, the logarithm of the radius a random Fourier series."""
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    order = np.arange(1, 9)
    waves = np.cos(np.outer(angle, order) + rng.uniform(0, 2 * np.pi, 8))
    return _unit_square(angle, np.exp(waves @ (rng.normal(0, 0.5, 8) / order)))


def _ellipse_outline(rng: np.random.Generator) -> NDArray[np.float64]:
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    radius = 1 / np.hypot(np.cos(angle), np.sin(angle) / rng.uniform(0.35, 1))
    return _unit_square(angle + rng.uniform(0, np.pi), radius)


def _polygon_outline(rng: np.random.Generator) -> NDArray[np.float64]:
    """Three to nine corners around a point; often not convex."""
    corners = int(rng.integers(3, 10))
    angle = 2 * np.pi / corners * (np.arange(corners) + rng.uniform(-0.35, 0.35, corners)) + rng.uniform(0, 7)
    return _unit_square(angle, rng.uniform(0.4, 1, corners))


def _unit_square(angle: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an outline from a point inside: (x, y), shape (N, 2), scaled to fill the unit square."""
    points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    low = points.min(0)
    return np.asarray((points - low) / (points.max(0) - low))


def _fixed_point(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(points * 16).astype(np.int32)  # OpenCV's coordinates, here with 4 fractional bits


def _fill_polygon(canvas: NDArray[np.uint8], points: NDArray[np.float64], level: int) -> None:
    cv2.fillPoly(canvas, [_fixed_point(points)], level, cv2.LINE_AA, 4)


def draw_texture(rng: np.random.Generator, size: tuple[int, int] = ImageSettings.drawn_size) -> Grey:
    """Draw fractal noise, a grating or checkerboard, polygons, or strokes like writing.

    Args:
        rng: Random numbers.
        size: Rows and columns [px].

    Returns:
        Intensity in [0, 1], shape `size`; its darkest and brightest level are random, too.
    """
    unit = (_fractal_noise, _draw_grating, _draw_polygons, _draw_strokes)[rng.integers(4)](rng, size)
    levels = rng.permutation([rng.uniform(0, 0.4), rng.uniform(0.6, 1)])
    return np.asarray(cv2.medianBlur(np.float32(levels[0] + (levels[1] - levels[0]) * unit), 3))


def _fractal_noise(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.float64]:
    """Noise whose amplitude falls as 1/f^slope, from 0.8 (sand) to 2 (clouds)."""
    frequency = np.hypot(np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1]))
    frequency[0, 0] = np.inf  # no mean
    spectrum = np.fft.rfft2(rng.standard_normal(size)) * frequency ** -rng.uniform(0.8, 2)
    noise = np.fft.irfft2(spectrum, size)
    return np.asarray(np.clip(0.5 + 0.2 * noise / noise.std(), 0, 1))


def _draw_grating(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.float64]:
    """Soft-edged stripes, or a checkerboard of two of them."""
    y, x = np.mgrid[: size[0], : size[1]]
    angle, period = rng.uniform(0, np.pi), rng.uniform(12, 96)
    along = 2 * np.pi / period * (x * np.cos(angle) + y * np.sin(angle)) + rng.uniform(0, 7)
    across = 2 * np.pi / period * (y * np.cos(angle) - x * np.sin(angle)) + rng.uniform(0, 7)
    wave = np.sin(along) * (np.sin(across) if rng.random() < 0.5 else 1)
    return np.asarray(0.5 + 0.5 * np.tanh(wave * rng.uniform(1, period / 4)))


def _draw_polygons(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.float64]:
    canvas = np.full(size, rng.integers(256), np.uint8)
    for width in np.geomspace(300, 30, int(rng.integers(15, 60))):  # the small ones last, on top
        corner = rng.uniform(-0.5 * width, size[::-1])
        _fill_polygon(canvas, corner + width * _polygon_outline(rng), int(rng.integers(256)))
    return canvas / 255


def _draw_strokes(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.float64]:
    """Lines of letters of two to four strokes, with spaces between words."""
    canvas = np.zeros(size, np.uint8)
    pitch = int(rng.integers(14, 48))  # from line to line [px]
    for top in range(pitch // 4, size[0] - pitch, pitch):
        for left in np.arange(pitch / 2, size[1] - pitch, 0.55 * pitch):
            if rng.random() < 0.85:
                letter = (left, top) + pitch * rng.uniform(0, (0.45, 0.7), (int(rng.integers(3, 6)), 2))
                cv2.polylines(canvas, [_fixed_point(letter)], False, 255, 1 + pitch // 16, cv2.LINE_AA, 4)
    return canvas / 255


def fit_picture(grey: Grey, rows: int, columns: int) -> Grey:
    """Return a picture (H, W) turned upright or level as asked for, scaled and cut to (rows, columns)."""
    if (grey.shape[0] > grey.shape[1]) != (rows > columns) and rows != columns:
        grey = np.rot90(grey)
    scale = max(rows / grey.shape[0], columns / grey.shape[1])
    size = max(columns, round(scale * grey.shape[1])), max(rows, round(scale * grey.shape[0]))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    scaled = cv2.resize(np.ascontiguousarray(grey), size, interpolation=way)
    top, left = (scaled.shape[0] - rows) // 2, (scaled.shape[1] - columns) // 2
    return np.ascontiguousarray(np.clip(scaled[top : top + rows, left : left + columns], 0, 1), np.float32)
