"""Writes docs/architecture.md and docs/architecture.png from the code: packages, floors, imports.

python docs/architecture.py
"""

from __future__ import annotations

import ast
import importlib.util
import json
import sys
import textwrap
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parents[1]


def _load_metrics() -> ModuleType:
    """Return perf/code_metrics.py, which knows floors and imports, without the root on the path."""
    spec = importlib.util.spec_from_file_location("code_metrics", ROOT / "perf" / "code_metrics.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["code_metrics"] = module
    spec.loader.exec_module(module)
    return module


metrics = _load_metrics()

COLUMN = {
    **dict.fromkeys(("datasets", "learning", "simulation", "effects", "scenes", "networks"), 0),
    **dict.fromkeys(("formatting", "errors"), 0),
    **dict.fromkeys(("cli", "tasks", "results", "signatures", "representations"), 1),
    **dict.fromkeys(("io", "events", "kernels"), 1),
    **dict.fromkeys(("figures", "diagnosis", "fitting", "probes", "recordings"), 2),
    **dict.fromkeys(("presets", "files", "version", "torch"), 2),
}
"""Where a package lies on its floor: what makes events is left, what asks about recordings is right."""

WAYS = {
    "scene → events": (
        ("scenes", "what moves, as light of every pixel and moment"),
        ("effects", "what the sensor does to it, one file each"),
        ("simulation", "puts the effects of a sensor together"),
        ("kernels", "one composed kernel runs them, pixel by pixel"),
        ("events", "sorted by time, through the readout"),
        ("io", "into a file"),
    ),
    "recording → finding": (
        ("io", "reads a file of any format"),
        ("recordings", "checks it, and says what looks odd"),
        ("probes", "statistics with a physical reading"),
        ("fitting", "simulates many models, compares the same"),
        ("diagnosis", "tries what the model lacks, on unseen pixels"),
        ("results", "frozen, with plain fields"),
        ("figures", "pictures and reports"),
    ),
}

INK, QUIET, BLUE, ORANGE = "#1c2733", "#6b7785", "#1f6fb2", "#c8601a"

PAGE = """# How dase is built

`docs/architecture.py` writes this page and draws the picture from the code; edit the text there.

![Packages on their floors, with the two ways through them](architecture.png)

Packages lie on floors, and imports go down: `tests/project/test_imports.py` holds every module to it, also
imports inside of functions. Grey lines are imports that no others imply; numbers are lines of the files.
Two ways lead through the house.

{ways}

## Floors

From top to bottom. A package may import what lies on lower floors, and its own modules, never what lies above
or beside it.

| packages | why there |
|---|---|
{floors}

## Packages

| package | what is in it |
|---|---|
{packages}

`dase/__init__.py` lends the public names, each loaded when it is first used. `kernels/` and `cli/` lie at
the top of the checkout and are imported as `dase.kernels` and `dase.cli`. Where something new goes, and
what belongs to it, is in [CONTRIBUTING.md](../CONTRIBUTING.md); how a sensor becomes a kernel is in
[method.md](method.md).
"""


class Package(NamedTuple):
    """A package, or a module that lies directly in dase/."""

    name: str
    lines: int
    says: str


def find_packages() -> dict[str, Package]:
    """Return all packages by name, from the highest floor to the lowest."""
    files: dict[str, list[Path]] = {}
    for path in metrics.source_files(ROOT):
        name = metrics.module_name(path.relative_to(ROOT))
        if "." in name:
            files.setdefault(name.split(".")[1], []).append(path)
    found = {}
    for name in (name for names, _ in metrics.FLOORS for name in names):
        own = files[name]
        first = next((path for path in own if path.name == "__init__.py"), own[0])
        text = ast.get_docstring(ast.parse(first.read_text("utf-8"))) or ""
        lines = sum(len(path.read_text("utf-8").splitlines()) for path in own)
        found[name] = Package(name, lines, text.split("\n")[0])
    assert set(found) == set(files), "a package has no floor in perf/code_metrics.py"
    return found


def find_imports() -> set[tuple[str, str]]:
    """Return pairs of packages of which the first imports the second, without pairs that others imply."""
    below: dict[str, set[str]] = {}
    for module, found in metrics.import_graph(ROOT).items():
        for one in found:
            if "." in module and "." in one.module:
                below.setdefault(module.split(".")[1], set()).add(one.module.split(".")[1])

    def reached(name: str, seen: set[str]) -> set[str]:
        for other in below.get(name, set()) - seen - {name}:
            seen.add(other)
            reached(other, seen)
        return seen

    pairs = set()
    for name, direct in below.items():
        for other in direct - {name}:
            between = direct - {name, other}
            if not any(other in reached(middle, set()) for middle in between):
                pairs.add((name, other))
    return pairs


def page() -> str:
    """Return docs/architecture.md."""
    packages = find_packages()
    ways = []
    for title, steps in WAYS.items():
        told = "\n".join(f"{n}. `{name}`: {what}" for n, (name, what) in enumerate(steps, 1))
        ways.append(f"**{title[0].upper()}{title[1:]}**\n\n{told}")
    floors = [f"| {', '.join(f'`{n}`' for n in names)} | {why} |" for names, why in metrics.FLOORS]
    rows = [f"| `{one.name}` | {one.says} |" for one in packages.values()]
    return PAGE.format(ways="\n\n".join(ways), floors="\n".join(floors), packages="\n".join(rows))


WIDE, TALL, ACROSS, STEP = 3.9, 0.74, 4.55, 1.06
"""Size of a box, and the distances of columns and floors [inch]."""

LEFT, TOP = 0.55, 1.4
"""Left edge of the first column, and middle of the highest floor [inch]."""


def place_of(name: str) -> tuple[float, float]:
    """Return the middle of a package's box; y grows downwards [inch]."""
    floor = metrics.floor_of(f"dase.{name}")
    x = LEFT + WIDE / 2 + COLUMN[name] * ACROSS
    return x, TOP + floor * STEP


def draw(path: Path) -> None:
    """Draw the packages on their floors, faint imports, and the two ways as coloured paths."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    packages, tall = find_packages(), TOP + len(metrics.FLOORS) * STEP - 0.3
    wide = 2 * LEFT + WIDE + 2 * ACROSS
    figure = Figure(figsize=(wide, tall), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, wide), ylim=(tall, 0))
    axes.axis("off")
    axes.text(LEFT, 0.45, "dase", fontsize=24, weight="bold", color=INK, va="center")
    told = "packages on their floors; imports go down; the two ways through the house"
    axes.text(LEFT + 1.0, 0.49, told, fontsize=13, color=QUIET, va="center")
    for floor in range(len(metrics.FLOORS)):
        y = TOP + floor * STEP
        if floor % 2 == 0:
            axes.axhspan(y - STEP / 2, y + STEP / 2, color="#f5f7f9", zorder=0)
    for above, under in sorted(find_imports()):
        draw_import(axes, above, under)
    for one in packages.values():
        draw_box(axes, one)
    draw_ways(axes)
    draw_legend(axes)
    known = json.dumps({"packages": sorted(packages)})
    figure.savefig(path, metadata={"Software": None, "Description": known})


def size_of(name: str) -> tuple[float, float]:
    """Return width and height of a box [inch]."""
    return (WIDE + 2 * ACROSS if name == "cli" else WIDE), TALL


def draw_box(axes: Axes, one: Package) -> None:
    """Draw a package: its name, its lines, what it says of itself."""
    from matplotlib.patches import FancyBboxPatch

    x, y = place_of(one.name)
    wide, tall = size_of(one.name)
    colours = [BLUE, ORANGE]
    on = [c for c, steps in zip(colours, WAYS.values(), strict=True) if one.name in dict(steps)]
    box = FancyBboxPatch(
        (x - wide / 2, y - tall / 2), wide, tall, boxstyle="round,pad=0,rounding_size=0.08",
        facecolor="white", edgecolor=on[0] if len(on) == 1 else INK if on else "#b9c2cc",
        linewidth=1.6 if on else 1.0, zorder=3,
    )  # fmt: skip
    axes.add_patch(box)
    left, right = x - wide / 2 + 0.14, x + wide / 2 - 0.14
    axes.text(left, y - 0.2, one.name, fontsize=12, weight="bold", color=INK, va="center", zorder=4)
    axes.text(right, y - 0.2, f"{one.lines:,}", fontsize=9, color=QUIET, va="center", ha="right", zorder=4)
    lines = textwrap.wrap(one.says.replace("`", "").rstrip(".:"), 58 if one.name != "cli" else 170)
    for k, text in enumerate(lines[:2]):
        axes.text(left, y + 0.05 + 0.18 * k, text, fontsize=8.6, color=INK, va="center", zorder=4)


def draw_import(axes: Axes, above: str, under: str) -> None:
    """Draw a faint line from the bottom of a box to the top of one below; behind all boxes."""
    from matplotlib.patches import FancyArrowPatch

    (x, y), (to, down) = place_of(above), place_of(under)
    if above == "cli":
        x = to
    shift = 0.22 * (to - x) / ACROSS
    axes.add_patch(
        FancyArrowPatch(
            (x + shift, y + TALL / 2), (to - shift, down - TALL / 2), arrowstyle="-|>", mutation_scale=7,
            color="#c3cbd3", linewidth=0.9, zorder=1, shrinkA=0, shrinkB=1,
        )
    )  # fmt: skip


def draw_ways(axes: Axes) -> None:
    """Draw the two ways, from box to box, in the columns and in the gaps between them."""
    first_gap, second_gap = (LEFT + WIDE + k * ACROSS + (ACROSS - WIDE) / 2 for k in (0, 1))

    def up(name: str, to: str) -> list[tuple[float, float]]:
        return [
            (place_of(name)[0], place_of(name)[1] - TALL / 2),
            (place_of(to)[0], place_of(to)[1] + TALL / 2),
        ]

    def across(name: str, to: str, gap: float) -> list[tuple[float, float]]:
        (x, y), (end, there) = place_of(name), place_of(to)
        side = WIDE / 2 if gap > x else -WIDE / 2
        other = -WIDE / 2 if end > gap else WIDE / 2
        return [(x + side, y), (gap, y), (gap, there), (end + other, there)]

    over = [
        (place_of("results")[0], place_of("results")[1] - TALL / 2),
        (place_of("results")[0], place_of("figures")[1]),
        (place_of("figures")[0] - WIDE / 2, place_of("figures")[1]),
    ]
    making = [
        up("scenes", "effects"), up("effects", "simulation"), across("simulation", "kernels", first_gap),
        up("kernels", "events"), up("events", "io"),
    ]  # fmt: skip
    asking = [
        across("io", "recordings", second_gap), up("recordings", "probes"), up("probes", "fitting"),
        up("fitting", "diagnosis"), across("diagnosis", "results", second_gap), over,
    ]  # fmt: skip
    for colour, routes in ((BLUE, making), (ORANGE, asking)):
        for route in routes:
            draw_route(axes, route, colour)
    for colour, side, steps in zip((BLUE, ORANGE), (-1, 1), WAYS.values(), strict=True):
        for n, (name, _) in enumerate(steps, 1):
            x, y = place_of(name)
            draw_number(axes, (x + side * WIDE / 2, y - TALL / 2), n, colour)


def draw_route(axes: Axes, points: list[tuple[float, float]], colour: str) -> None:
    """Draw a line with round corners and an arrow at its end."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path as Line

    places, codes, bend = [points[0]], [Line.MOVETO], 0.14
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        for other, code in ((before, Line.LINETO), (after, Line.CURVE3)):
            length = max(abs(other[0] - corner[0]), abs(other[1] - corner[1]))
            share = min(bend / length, 0.5)
            near = tuple(c + share * (o - c) for c, o in zip(corner, other, strict=True))
            places += [near] if code == Line.LINETO else [corner, near]
            codes += [code] if code == Line.LINETO else [code, code]
    line = Line([*places, points[-1]], [*codes, Line.LINETO])
    axes.add_patch(
        FancyArrowPatch(
            path=line, arrowstyle="-|>", mutation_scale=17, color=colour, linewidth=3.0, zorder=2,
            capstyle="butt", joinstyle="round", fill=False,
        )
    )  # fmt: skip


def draw_number(axes: Axes, at: tuple[float, float], number: int, colour: str) -> None:
    """Draw the number of a step."""
    from matplotlib.patches import Circle

    axes.add_patch(Circle(at, 0.135, facecolor=colour, edgecolor="white", linewidth=1.2, zorder=5))
    axes.text(
        *at,
        str(number),
        color="white",
        fontsize=9,
        weight="bold",
        ha="center",
        va="center_baseline",
        zorder=6,
    )


def draw_legend(axes: Axes) -> None:
    """Say what the steps of the two ways are, where the making column is empty."""
    from matplotlib.patches import Rectangle

    high, low = place_of("figures")[1] - 0.5, place_of("fitting")[1] + 0.52
    axes.add_patch(Rectangle((LEFT, high), WIDE, low - high, color="white", zorder=2))
    x, y = LEFT + 0.24, high + 0.17
    for colour, (title, steps) in zip((BLUE, ORANGE), WAYS.items(), strict=True):
        axes.text(x - 0.1, y, title, fontsize=12, weight="bold", color=colour, va="center", zorder=4)
        for n, (name, what) in enumerate(steps, 1):
            y += 0.19
            axes.text(x - 0.1, y, str(n), fontsize=8.6, weight="bold", color=colour, va="center", zorder=4)
            axes.text(x + 0.1, y, f"{name}: {what}", fontsize=8.6, color=INK, va="center", zorder=4)
        y += 0.3


def main() -> None:
    """Write the page and its picture."""
    folder = ROOT / "docs"
    (folder / "architecture.md").write_text(page(), "utf-8")
    draw(folder / "architecture.png")


if __name__ == "__main__":
    main()
