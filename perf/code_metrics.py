"""How the code reads, in numbers: the table by which the project compares itself with well-kept code bases.

    python -m perf.code_metrics                               one line per package, and the whole
    python -m perf.code_metrics --list one_word dase/fitting  what is counted, by name
    python -m perf.code_metrics OTHER_TREE

What a column counts:

- files, med, p90: Python files without tests and perf, and the lines of them
- fn med, fn p90: lines of functions and methods, without those inside of other functions
- >6: functions with more than 6 parameters (without `self`), per 100
- doc: public functions, methods and classes with a docstring, per 100
- unit: public functions with a docstring that say a shape or a unit, per 100 of those with a docstring
- arrays, %: public functions that take or return an array, and the part of them that says a shape or a unit
- com: lines with a comment per 100 lines of code (neither blank, comment nor docstring)
- const: upper-case names bound at module level, per 1000 lines
- 1word: functions of a module (no kernels) named by one word, per 100
- root: modules directly in dase/
- depth, circles: longest chain of imports between modules, and groups of modules that import each other, by
  imports at module level and in functions, without those for type checkers

`--list` takes one_word, constants, parameters, undocumented, arrays (that say neither shape nor unit), late
(imports of dase inside of functions), circles and long (functions longer than 40 lines).
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import NamedTuple

HARD_FILES = (
    "kernels/pixel_codegen*.py",
    "dase/fitting/batch_simulator.py",
    "dase/fitting/descent.py",
    "dase/fitting/data_split.py",
    "dase/fitting/subset.py",
    "dase/fitting/scheduler.py",
    "dase/fitting/readout_simulator.py",
)
"""Files of which the reader has a right to more comments than elsewhere."""

SHAPE_OR_UNIT = re.compile(
    r"\((?:[\w·*+\-/. ×]+,)+[\w·*+\-/.… ×]*\)"  # (H, W), (n,), (B, 2, *S)
    r"|\bshape\b|\bscalar\b|\b0-d\b|\b[1-4]-?D\b|\bone (?:number |value )?(?:per|for each|a) \w+"
    r"|\[(?:[^\]]{1,24})\](?!\()"  # [s], [log intensity]; not a link
    r"|\bin (?:s|ns|µs|ms|Hz|px|bits?|bytes?|seconds|pixels|nanoseconds|microseconds)\b"
)
"""What counts as saying the shape or the unit of something."""

ARRAYS = r"ndarray|NDArray|ArrayLike|Tensor|wp\.array\w*|array[1-4]d"
"""Names of types of arrays, besides those that the tree gives them itself."""

FLOORS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("cli",), "Commands may use everything; nothing uses them."),
    (
        ("datasets", "tasks"),
        "Whole data sets are written, networks trained and tested with all of the below, pictures included.",
    ),
    (("figures",), "Pictures and pages show what was found; nothing that is computed depends on them."),
    (("diagnosis",), "What a model lacks is asked with many fits."),
    (("fitting",), "Parameters are fitted by simulating many models and comparing statistics."),
    (
        ("results", "learning", "torch"),
        "Results hold sensors; learning makes thresholds for them, without any fit; batches need sensors.",
    ),
    (("simulation",), "A sensor puts effects together and runs them over a scene."),
    (("effects",), "An effect knows scenes, kernels and which signatures it makes, not the sensor."),
    (("signatures",), "What events show by themselves is found without any sensor."),
    (("probes",), "A statistic knows only events."),
    (
        ("recordings", "scenes", "representations"),
        "What a camera wrote, what it looks at, and what networks are given of its events.",
    ),
    (("io", "networks", "presets"), "Files know events, not what they are used for."),
    (
        ("events", "formatting", "files"),
        "What everybody speaks of: events, readable numbers, whole files.",
    ),
    (("errors", "version", "kernels"), "Kernels know nothing of dase, so that each can be read by itself."),
)
"""Packages from top to bottom, and why they lie there; imports go down, never up or sideways."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


class Found(NamedTuple):
    """One thing that is counted, and where it is."""

    path: Path
    line: int
    name: str


@dataclass
class Count:
    """What is counted in a package or in all of them."""

    files: list[int] = field(default_factory=list)
    functions: list[int] = field(default_factory=list)
    code: int = 0
    comments: int = 0
    public: int = 0
    documented: int = 0
    described: int = 0
    arrays: int = 0
    arrays_described: int = 0
    module_functions: int = 0
    lists: dict[str, list[Found]] = field(default_factory=dict)

    def note(self, kind: str, path: Path, line: int, name: str) -> None:
        """Put something on the list of its kind."""
        self.lists.setdefault(kind, []).append(Found(path, line, name))

    def number(self, kind: str) -> int:
        """Return how many of a kind there are."""
        return len(self.lists.get(kind, ()))

    def add(self, other: Count) -> None:
        """Add what was counted elsewhere."""
        for name, value in vars(other).items():
            if isinstance(value, dict):
                for kind, found in value.items():
                    self.lists.setdefault(kind, []).extend(found)
            else:
                setattr(self, name, getattr(self, name) + value)


def source_files(root: Path) -> Iterator[Path]:
    """Yield the files that count; the links dase/kernels and dase/cli lead to what is walked anyway."""
    for top in ("dase", "kernels", "cli"):
        for path in sorted((root / top).rglob("*.py")):
            inside = path.relative_to(root)
            if not (top == "dase" and inside.parts[1] in ("kernels", "cli")):
                yield path


def module_name(path: Path) -> str:
    """Return the name that a file, given from the root, is imported by."""
    parts = path.with_suffix("").parts
    parts = parts if parts[0] == "dase" else ("dase", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def floor_of(module: str) -> int:
    """Return the floor of a module, 0 for the highest; `dase` itself, which lends out names, is above."""
    part = module.split(".")[1] if "." in module else module
    return next((k for k, (names, _) in enumerate(FLOORS) if part in names), -1)


def package_of(path: Path) -> str:
    """Return the package of a file, given from the root."""
    if path.parts[0] != "dase":
        return path.parts[0]
    return path.parts[1] if len(path.parts) > 2 else "dase itself"


def count_lines(text: str, tree: ast.Module) -> tuple[int, int]:
    """Return how many lines have code, and how many a comment."""
    docs: set[int] = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            docs |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    code: set[int] = set()
    comments: set[int] = set()
    layout = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            if not re.match(r"# (type:|noqa)", token.string):
                comments.add(token.start[0])
        elif token.type not in layout:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(code - docs), len(comments)


def outer_functions(nodes: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, Function | ast.ClassDef]]:
    """Yield classes, functions and methods with their names, not what is defined inside of functions."""
    for node in nodes:
        if isinstance(node, Function):
            yield prefix + node.name, node
        elif isinstance(node, ast.ClassDef):
            yield prefix + node.name, node
            yield from outer_functions(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, ast.If):
            yield from outer_functions(node.body + node.orelse, prefix)
        elif isinstance(node, ast.Try):
            yield from outer_functions(node.body + [s for h in node.handlers for s in h.body], prefix)


def decorators(node: Function | ast.ClassDef) -> str:
    """Return the decorators as text."""
    return " ".join(map(ast.unparse, node.decorator_list))


def signature(node: Function, lines: list[str]) -> str:
    """Return the text from `def` to the body, with comments: kernels say shapes there."""
    return "\n".join(lines[node.lineno - 1 : max(node.body[0].lineno - 1, node.lineno)])


def array_names(root: Path) -> re.Pattern[str]:
    """Return what finds names of types of arrays, those of `Array = NDArray[...]` in a module among them."""
    own: set[str] = set()
    for path in source_files(root):
        own |= set(re.findall(rf"^(\w+) = (?:{ARRAYS})\[", path.read_text("utf-8"), flags=re.MULTILINE))
    return re.compile(rf"\b(?:{'|'.join([ARRAYS, *sorted(own)])})\b")


def takes_arrays(node: Function, names: re.Pattern[str]) -> bool:
    """Whether an argument or the result is annotated as an array."""
    a = node.args
    known = [*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg]
    annotations = [one.annotation for one in known if one is not None and one.annotation is not None]
    annotations += [node.returns] if node.returns is not None else []
    return any(names.search(ast.unparse(one)) for one in annotations)


def count_function(
    count: Count, path: Path, name: str, node: Function, lines: list[str], arrays: re.Pattern[str]
) -> None:
    """Count a function or method."""
    length = (node.end_lineno or node.lineno) - node.lineno + 1
    count.functions.append(length)
    if length > 40:
        count.note("long", path, node.lineno, f"{name}: {length} lines")
    kernel = "wp.kernel" in decorators(node)
    a = node.args
    given = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs) if one.arg not in ("self", "cls")]
    if len(given) > 6:
        count.note("parameters", path, node.lineno, f"{name}: {len(given)}")
    if "." not in name and not kernel:
        count.module_functions += 1
        if "_" not in name.strip("_"):
            count.note("one_word", path, node.lineno, name)
    if any(part.startswith("_") for part in name.split(".")) or "setter" in decorators(node):
        return
    text = ast.get_docstring(node)
    if "overload" in decorators(node):
        return
    count.public += 1
    if text is None:
        count.note("undocumented", path, node.lineno, name)
        return
    count.documented += 1
    said = bool(SHAPE_OR_UNIT.search(text)) or ("wp." in decorators(node) and "# " in signature(node, lines))
    count.described += said
    if takes_arrays(node, arrays):
        count.arrays += 1
        count.arrays_described += said
        if not said:
            count.note("arrays", path, node.lineno, name)


def count_file(root: Path, path: Path, arrays: re.Pattern[str]) -> Count:
    """Count what is in one file."""
    text = path.read_text("utf-8")
    tree, lines, inside = ast.parse(text), text.splitlines(), path.relative_to(root)
    count = Count(files=[len(lines)])
    count.code, count.comments = count_lines(text, tree)
    for name, node in outer_functions(tree.body):
        if not isinstance(node, ast.ClassDef):
            count_function(count, inside, name, node, lines, arrays)
        elif not any(part.startswith("_") for part in name.split(".")):
            count.public += 1
            count.documented += ast.get_docstring(node) is not None
    for name, line in constants(tree):
        count.note("constants", inside, line, name)
    return count


def constants(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield upper-case names that a module binds: numbers, tables, texts; not type variables."""
    for node in tree.body:
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            targets = list(node.targets)
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets = [node.target]
        names = [n for t in targets for n in (t.elts if isinstance(t, ast.Tuple) else [t])]
        for name in names:
            upper = isinstance(name, ast.Name) and re.fullmatch(r"_*[A-Z][A-Z0-9_]*", name.id)
            if upper and "TypeVar" not in ast.unparse(node):
                yield ast.unparse(name), node.lineno


class Import(NamedTuple):
    """One import of a module of dase."""

    module: str
    line: int
    late: bool
    """Whether it is inside of a function."""


def imports_of(tree: ast.Module, modules: set[str], itself: str, *, package: bool) -> Iterator[Import]:
    """Yield what a module imports from others of `modules`, without what only type checkers see."""

    def walk(nodes: list[ast.stmt], late: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
        for node in nodes:
            if isinstance(node, ast.Import | ast.ImportFrom):
                yield node, late
            elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
                inner = late or isinstance(node, Function)
                for name in ("body", "orelse", "finalbody"):
                    yield from walk(getattr(node, name, []), inner)
                for handler in getattr(node, "handlers", []):
                    yield from walk(handler.body, inner)

    for node, late in walk(tree.body, False):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            base = node.module or ""
            if node.level:  # relative
                parts = itself.split(".")
                up = parts[: len(parts) - node.level + package]
                base = ".".join([*up, *([base] if base else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        for name in names:
            while name and name not in modules:
                name = name.rpartition(".")[0]
            if name and name != itself:
                yield Import(name, node.lineno, late)


def import_graph(root: Path) -> dict[str, list[Import]]:
    """Return the imports of each module, by its name."""
    paths = {module_name(path.relative_to(root)): path for path in source_files(root)}
    graph = {}
    for name, path in paths.items():
        tree = ast.parse(path.read_text("utf-8"))
        graph[name] = list(imports_of(tree, set(paths), name, package=path.name == "__init__.py"))
    return graph


def find_circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that reach each other, each sorted (Tarjan's algorithm)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    circles = []

    def visit(one: str) -> None:
        index[one] = low[one] = len(index)
        stack.append(one)
        for other in sorted(edges[one]):
            if other not in index:
                visit(other)
                low[one] = min(low[one], low[other])
            elif other in stack:
                low[one] = min(low[one], index[other])
        if low[one] == index[one]:
            group = stack[stack.index(one) :]
            del stack[stack.index(one) :]
            if len(group) > 1:
                circles.append(sorted(group))

    for one in sorted(edges):
        if one not in index:
            visit(one)
    return circles


def import_depth(edges: dict[str, set[str]]) -> int:
    """Return the number of modules on the longest chain of imports; a circle counts as its modules, once."""
    circle_of = {one: tuple(group) for group in find_circles(edges) for one in group}
    memory: dict[tuple[str, ...], int] = {}

    def depth(group: tuple[str, ...]) -> int:
        if group not in memory:
            below = {circle_of.get(t, (t,)) for one in group for t in edges[one]} - {group}
            memory[group] = len(group) + max(map(depth, below), default=0)
        return memory[group]

    return max(depth(circle_of.get(one, (one,))) for one in edges)


def module_edges(graph: dict[str, list[Import]]) -> dict[str, set[str]]:
    """Return which modules each one imports; packages count where their own file is asked for a name."""
    return {one: {i.module for i in found} for one, found in graph.items()}


def measure(root: Path) -> dict[str, Count]:
    """Count every package of a tree, and `total`."""
    counts: dict[str, Count] = {}
    arrays = array_names(root)
    for path in source_files(root):
        counts.setdefault(package_of(path.relative_to(root)), Count()).add(count_file(root, path, arrays))
    for name, found in import_graph(root).items():
        path = Path(*name.split("."))
        inside = Path(*path.parts[1:]) if path.parts[1:2] in (("kernels",), ("cli",)) else path
        if inside.parts[0] != "cli":  # commands import late, so that --help is instant
            part = package_of(inside.with_suffix(".py") if len(inside.parts) > 1 else inside / "__init__.py")
            for one in found:
                if one.late:
                    counts.setdefault(part, Count()).note("late", inside, one.line, one.module)
    total = Count()
    for one in counts.values():
        total.add(one)
    counts["total"] = total
    for group in find_circles(module_edges(import_graph(root))):
        total.note("circles", Path(), 0, " ".join(group))
    return counts


def p90(numbers: list[int]) -> int:
    """Return the number that nine in ten do not exceed."""
    return sorted(numbers)[int(0.9 * (len(numbers) - 1))] if numbers else 0


def share(part: int, whole: int, of: int = 100, *, digits: int = 0) -> str:
    """Return a part of a whole per 100."""
    return f"{of * part / whole:.{digits}f}" if whole else "-"


COLUMNS = [
    *("package", "files", "med", "p90", "|", "fn", "med", "p90", ">6", "|"),
    *("doc", "unit", "arrays", "%", "|", "com", "const", "1word", "|", "late"),
]


def row(name: str, count: Count) -> list[str]:
    """Return a line of the table."""
    lines = sum(count.files)
    return [
        name, str(len(count.files)), f"{median(count.files):.0f}", str(p90(count.files)), "|",
        str(len(count.functions)), f"{median(count.functions or [0]):.0f}", str(p90(count.functions)),
        share(count.number("parameters"), len(count.functions)), "|",
        share(count.documented, count.public), share(count.described, count.documented),
        str(count.arrays), share(count.arrays_described, count.arrays), "|",
        share(count.comments, count.code, digits=1),
        f"{1000 * count.number('constants') / max(lines, 1):.1f}",
        share(count.number("one_word"), count.module_functions), "|", str(count.number("late")),
    ]  # fmt: skip


def print_table(root: Path) -> None:
    """Print the table of a tree."""
    counts = measure(root)
    rows = [COLUMNS, *(row(name, counts[name]) for name in sorted(counts, key=lambda n: (n == "total", n)))]
    widths = [max(len(one[k]) for one in rows) for k in range(len(COLUMNS))]
    for one in rows:
        (first, width), *others = zip(one, widths, strict=True)
        print("  ".join([first.ljust(width), *(text.rjust(room) for text, room in others)]))
    print("\nComments per 100 lines of code of the hard files:")
    for pattern in HARD_FILES:
        for path in sorted(root.glob(pattern)):
            text = path.read_text("utf-8")
            code, comments = count_lines(text, ast.parse(text))
            print(f"  {path.relative_to(root)}: {share(comments, code, digits=1)}")
    edges = module_edges(import_graph(root))
    flat = len(list((root / "dase").glob("*.py")))
    total = counts["total"]
    print(
        f"\n{sum(total.files)} lines, {flat} modules directly in dase/, imports {import_depth(edges)} deep, "
        f"{total.number('circles')} circles, {total.number('constants')} constants, "
        f"{total.number('one_word')} of {total.module_functions} functions named by one word"
    )


def main() -> None:
    """Print the table or a list."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tree", nargs="?", default=".", help="root of a checkout")
    parser.add_argument("--list", metavar="KIND", help="name what is counted")
    args, rest = parser.parse_known_args()
    root, within = Path(args.tree), [*rest]
    if args.list is None:
        print_table(root)
        return
    if not (root / "dase").is_dir() or not (root / "kernels").is_dir():  # a folder of this tree was meant
        root, within = Path(), [args.tree, *rest]
    for one in measure(root)["total"].lists.get(args.list, []):
        if not within or any(str(one.path).startswith(prefix) for prefix in within):
            print(f"{one.path}:{one.line} {one.name}")


if __name__ == "__main__":
    main()
