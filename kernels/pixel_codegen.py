"""Statements of a kernel as data: what a line says, what it reads and writes, on what it depends.

`pixel_codegen_program` makes statements from the stage functions of effects, once and without regard to how a
thread is laid out. What becomes of them is the business of `pixel_codegen_cuda` (a pixel per thread),
`pixel_codegen_cpu` (a block of pixels per thread) and `pixel_codegen_trials` (many models of one pixel): they
wrap statements in loops and conditions, and ask them which names they need and change. None of them looks
into a text.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

from dase.kernels.pixel_stages import EffectStages


@dataclass(frozen=True)
class Draw:
    """Random numbers of a pixel that a statement asks for.

    Args:
        name: Of the stream, and of the number itself where there is one per pixel. The key of the stream is
            called after it.
        kind: `uniform` or `normal`.
        effect: Whose numbers they are; None for the change detector's own.
        per_pixel: Whether one number is drawn per pixel, instead of one per sample or event.
    """

    name: str
    kind: str
    effect: EffectStages | None = None
    per_pixel: bool = False

    @property
    def key(self) -> str:
        """Name of the stream's key in the kernel."""
        return f"{self.name}_key"


@dataclass(frozen=True)
class Line:
    """One line without a body."""

    text: str
    draws: tuple[Draw, ...] = ()  # keys are made before the first sample, so a line must tell

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order in which the text mentions them."""
        return _flow(self.text)[0]

    @property
    def reads(self) -> frozenset[str]:
        """Names whose values the line asks for."""
        return _flow(self.text)[1]

    @property
    def writes(self) -> frozenset[str]:
        """Names that the line gives a value."""
        return _flow(self.text)[2]


@dataclass(frozen=True)
class Block:
    """A loop or a condition.

    Args:
        head: Its first line, with the colon.
        body: What it repeats, or does where the condition holds.
        otherwise: What a condition does where it does not hold.
        draws: Random numbers that the head asks for.
        acting: Effects of which one must act for the condition to hold; empty where it is about anything
            else.
    """

    head: str
    body: tuple[Statement, ...]
    otherwise: tuple[Statement, ...] = ()
    draws: tuple[Draw, ...] = ()
    acting: tuple[EffectStages, ...] = ()


@dataclass(frozen=True)
class Guarded:
    """What an effect does: nothing where it is off. Kernels that know it is on leave the question out."""

    effect: EffectStages
    body: tuple[Statement, ...]


Statement: TypeAlias = Line | Block | Guarded


@dataclass(frozen=True)
class Part:
    """What every pixel does at one point of a sample.

    Parts are the units between which the pixels of a block wait for each other: a part is one loop over the
    block. The shorter a part, the more likely is the loop to become vectors.

    Args:
        body: Statements, the same for all pixels.
        when: Conditions; one that differs from pixel to pixel may be left out, as nothing happens where it
            does not hold.
        then: What is done under the same conditions once for all pixels.
        handover: Whether results are handed over, which of two overlapping blocks only one may do.
    """

    body: tuple[Statement, ...]
    when: tuple[str, ...] = ()
    then: tuple[Statement, ...] = ()
    handover: bool = False


@lru_cache(maxsize=8192)
def _flow(text: str) -> tuple[tuple[str, ...], frozenset[str], frozenset[str]]:
    """Return the names of a line, those that it reads, and those that it writes."""
    # heads of blocks are no statements by themselves
    tree = ast.parse(f"{text} pass" if text.endswith(":") else text)
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    # `ast.walk` goes level by level, not from left to right
    found.sort(key=lambda node: node.col_offset)
    writes = frozenset(node.id for node in found if isinstance(node.ctx, ast.Store))
    reads = frozenset(node.id for node in found if isinstance(node.ctx, ast.Load))
    # Python's syntax tree says only that `a += b` stores `a`
    if isinstance(tree.body[0], ast.AugAssign):
        reads |= writes
    return tuple(dict.fromkeys(node.id for node in found)), reads, writes


def lines(*texts: str) -> tuple[Line, ...]:
    """Return lines without random numbers."""
    return tuple(Line(text) for text in texts)


def if_block(condition: str, *body: Statement | str) -> Block:
    """Return a condition with its body; a text stands for a line."""
    return Block(f"if {condition}:", tuple(Line(s) if isinstance(s, str) else s for s in body))


def every_line(statements: Iterable[Statement]) -> Iterator[Line]:
    """Yield all lines in order, the heads of blocks among them."""
    for statement in statements:
        if isinstance(statement, Line):
            yield statement
            continue
        if isinstance(statement, Block):
            # conditions read names, and may ask for random numbers, as lines do
            yield Line(statement.head, statement.draws)
        yield from every_line(statement.body)
        if isinstance(statement, Block):
            yield from every_line(statement.otherwise)


def draws_of(statements: Iterable[Statement]) -> tuple[Draw, ...]:
    """Return the random numbers that statements ask for, each once, in the order of the text."""
    # a set would do for the numbers, which depend on names alone; but a sensor must always get the same text,
    # or the cache of compiled kernels would not know it
    return tuple(dict.fromkeys(draw for line in every_line(statements) for draw in line.draws))


def names_needed(statements: Iterable[Statement]) -> dict[str, bool]:
    """Return all names in the order of the text, and whether their values are needed from before.

    They are not where the first mention of a name gives it a value whatever happens: an assignment that
    stands in no block.
    """
    needed: dict[str, bool] = {}
    for statement in statements:
        # a block may be left out: what it sets keeps its old value then, so that this is needed
        given = statement.writes - statement.reads if isinstance(statement, Line) else frozenset()
        for line in every_line((statement,)):
            for name in line.names:
                needed.setdefault(name, name not in given)
    return needed


def names_written(statements: Iterable[Statement]) -> set[str]:
    """Return the names that statements may give a value."""
    return {name for line in every_line(statements) for name in line.writes}


def acting(effect: EffectStages) -> str:
    """Return the condition on which an effect of a kernel for many models acts."""
    return f"{effect.name}_acts != 0"


def resolve_guards(statements: Iterable[Statement], *, ask: bool) -> tuple[Statement, ...]:
    """Return statements without `Guarded`.

    Args:
        statements: Of any depth.
        ask: Whether the kernel asks if an effect acts. An effect that has no off values always does.
    """
    found: list[Statement] = []
    for statement in statements:
        if isinstance(statement, Line):
            found.append(statement)
            continue
        body = resolve_guards(statement.body, ask=ask)
        if isinstance(statement, Block):
            otherwise = resolve_guards(statement.otherwise, ask=ask)
            found.append(replace(statement, body=body, otherwise=otherwise))
        # the same numbers come out either way: a guard saves the time of what would change nothing
        elif ask and statement.effect.off:
            # `acting` stays behind: a layout with lanes asks once for all of them
            found.append(Block(f"if {acting(statement.effect)}:", body, acting=(statement.effect,)))
        else:
            found += body
    return tuple(found)


def print_statements(statements: Iterable[Statement], depth: int = 0) -> list[str]:
    """Return the lines of a text; guards must have been resolved."""
    text: list[str] = []
    indent = "    " * depth
    for statement in statements:
        if isinstance(statement, Line):
            text.append(indent + statement.text)
            continue
        assert isinstance(statement, Block)  # there are no guards left
        text += [indent + statement.head, *print_statements(statement.body, depth + 1)]
        if statement.otherwise:
            text += [indent + "else:", *print_statements(statement.otherwise, depth + 1)]
    return text


def print_kernel(head: Iterable[str], body: Iterable[Statement]) -> str:
    """Return the whole text of a kernel from the lines of its head and its statements."""
    return "\n".join([*head, *print_statements(body, 1)]) + "\n"
