"""Steps on a thread of their own: their order, what they hold, and what becomes of it when one fails."""

import threading
import time
from contextlib import contextmanager

import pytest

from dase.datasets.steps_in_order import StepsInOrder


class Held:
    """What is held, and what befell it."""

    def __init__(self):
        self.done, self.threads, self.left_by = [], set(), []

    @contextmanager
    def opened(self):
        self.threads.add(threading.get_ident())
        try:
            yield self
        except BaseException as error:
            self.left_by.append(error)
            raise
        self.left_by.append(None)

    def step(self, number, seconds=0.0):
        def do(held):
            time.sleep(seconds)
            held.threads.add(threading.get_ident())
            held.done.append(number)
            return number * number

        return do


def add_many(steps, held):
    for number in range(2, 100):
        steps.add(held.step(number, 0.02))


def finish(steps):
    found = []
    while not steps.is_done():
        found += steps.results()
    return found + list(steps.results())


def test_steps_are_done_in_their_order_on_one_other_thread():
    held = Held()
    steps = StepsInOrder(held.opened(), most=2, look=0.01)
    found = []
    for number in range(6):
        steps.add(held.step(number, 0.02))
        found += steps.results()
    steps.end()
    found += finish(steps)
    assert held.done == list(range(6))
    assert found == [n * n for n in range(6)]
    assert held.left_by == [None]
    assert len(held.threads) == 1
    assert threading.get_ident() not in held.threads


def test_a_step_that_fails_is_the_last_and_the_caller_hears_of_it():
    held, error = Held(), OSError("disk full")

    def fail(_):
        raise error

    steps = StepsInOrder(held.opened(), most=1, look=0.01)
    steps.add(held.step(1))
    steps.add(fail)
    with pytest.raises(OSError, match="disk full"):
        add_many(steps, held)
    steps.abandon(KeyboardInterrupt())
    assert held.done == [1]
    assert held.left_by == [error]


def test_what_cannot_be_opened_is_heard_of_although_nothing_follows():
    @contextmanager
    def closed():
        raise PermissionError("no")
        yield

    steps = StepsInOrder(closed(), look=0.01)
    with pytest.raises(PermissionError):
        finish(steps)


def test_abandoning_leaves_as_by_the_error_without_the_steps_that_wait():
    held, going, error = Held(), threading.Event(), KeyboardInterrupt()

    def wait(_):
        going.set()
        time.sleep(0.1)
        held.done.append("begun")

    steps = StepsInOrder(held.opened(), look=0.01)
    steps.add(wait)
    for number in range(5):
        steps.add(held.step(number))
    going.wait()
    steps.abandon(error)
    assert held.done == ["begun"]
    assert held.left_by == [error]
