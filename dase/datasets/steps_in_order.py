"""Steps that are done on a thread of their own, beside what the caller does next."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from queue import Empty, Full, Queue
from typing import Generic, TypeVar

Held = TypeVar("Held")
Result = TypeVar("Result")


class StepsInOrder(Generic[Held, Result]):
    """Steps with something that is held, such as a file, one after the other on a thread of their own.

    What is held is entered and left on that thread. A step that fails is the last one: what is held is left
    as by its error, which the caller's next `add` or `is_done` raises. Ends with `is_done` or `abandon`.

    Args:
        context: Gives what is held.
        most: Steps that may wait; more hold the caller up, so that memory does not grow.
        look: Time between two looks at the thread while the caller waits [s].
    """

    def __init__(self, context: AbstractContextManager[Held], *, most: int = 16, look: float = 0.1):
        self._look = look
        self._steps: Queue[Callable[[Held], Result] | None] = Queue(most)
        self._results: deque[Result] = deque()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="dase steps")
        self._work = self._pool.submit(self._do_steps, context)

    def _do_steps(self, context: AbstractContextManager[Held]) -> None:
        with context as held:
            while (step := self._steps.get()) is not None:
                self._results.append(step(held))

    def add(self, step: Callable[[Held], Result]) -> None:
        """Have a step done behind those before it."""
        self._put(step)

    def end(self) -> None:
        """Have what is held left, behind all steps."""
        self._put(None)

    def _put(self, step: Callable[[Held], Result] | None) -> None:
        while True:
            if self._work.done():
                self._work.result()
            try:
                self._steps.put(step, timeout=self._look)
                return
            except Full:
                continue

    def results(self) -> Iterator[Result]:
        """Yield what steps gave that are done by now, each once."""
        while self._results:
            yield self._results.popleft()

    def is_done(self) -> bool:
        """Wait a little, and return whether all steps are done and what is held is left."""
        if not wait([self._work], timeout=self._look).done:
            return False
        self._pool.shutdown()
        self._work.result()
        return True

    def abandon(self, error: BaseException) -> None:
        """Leave what is held as by an error, behind the step that is being done and without the others."""

        def fail(held: Held) -> Result:
            raise error

        try:
            while True:
                self._steps.get_nowait()
        except Empty:
            self._steps.put(fail)
        wait([self._work])
        self._pool.shutdown()
