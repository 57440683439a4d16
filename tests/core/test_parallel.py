"""Threads over independent work: order, number, errors, and that a quasi-static path does not depend on how many there are."""

from __future__ import annotations

import threading
import time
from operator import attrgetter

import numpy as np
import pytest
import threadpoolctl
from driven import recording, robot

from femsense.core import parallel
from femsense.core.errors import DataError, InputError
from femsense.core.parallel import beside, each, set_workers, workers
from femsense.core.work import Work, counting
from femsense.core.work import count as counted
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import solve_path


@pytest.fixture(autouse=True)
def _as_before():
    yield
    set_workers(None)


@pytest.mark.parametrize("threads", [1, 3])
def test_work_is_counted_whoever_does_it(threads: int):
    set_workers(threads)
    with counting() as work:
        list(each(lambda i: counted(equilibria=i), range(5)))
    assert work == Work(equilibria=10)


def test_results_come_in_order_and_little_is_worked_on_ahead():
    set_workers(3)
    taken: list[int] = []
    items = (taken.append(i) or i for i in range(40))

    def slow_first(i: int) -> int:
        time.sleep(0.02 if i % 5 == 0 else 0.0)
        return i * i

    for i, answer in enumerate(each(slow_first, items)):
        assert answer == i * i and len(taken) <= i + 2 * 3


def test_one_worker_works_in_this_thread():
    set_workers(1)
    assert set(each(lambda _: threading.get_ident(), range(4))) == {threading.get_ident()}


BLAS = threadpoolctl.ThreadpoolController().select(user_api="blas")


def blas_threads(*_: object) -> int:
    return max(library["num_threads"] for library in BLAS.info())


@pytest.fixture
def _two_blas_threads():
    with BLAS.limit(limits=2):
        if blas_threads() < 2:
            pytest.skip("this BLAS has one thread")
        yield


@pytest.mark.usefixtures("_two_blas_threads")
@pytest.mark.parametrize("count", [1, 2])
def test_blas_takes_one_thread_while_ours_work_and_has_its_own_back_afterwards(count: int):
    set_workers(count)
    assert set(each(blas_threads, range(4))) == {1} and blas_threads() == 2
    with beside(lambda: list(each(blas_threads, range(20)))):
        list(each(blas_threads, range(20)))
    assert blas_threads() == 2


def test_the_first_error_arrives_and_the_rest_is_left():
    set_workers(2)
    done: list[int] = []

    def fail(i: int) -> int:
        if i == 1:
            raise DataError("frame 1")
        done.append(i)
        return i

    with pytest.raises(DataError, match="frame 1"):
        list(each(fail, range(1000)))
    assert len(done) < 10


def test_how_many_work_is_chosen_by_hand_then_by_the_environment_then_by_the_machine(monkeypatch):
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.delenv("FEMSENSE_WORKERS", raising=False)
    assert 1 <= workers() <= parallel.MOST
    monkeypatch.setenv("PYTEST_XDIST_WORKER", "gw0")
    assert workers() == 1
    monkeypatch.setenv("FEMSENSE_WORKERS", "3")
    assert workers() == 3
    set_workers(2)
    assert workers() == 2
    with pytest.raises(InputError, match="number of threads"):
        set_workers(0)
    set_workers(None)
    monkeypatch.setenv("FEMSENSE_WORKERS", "many")
    with pytest.raises(InputError, match="FEMSENSE_WORKERS"):
        workers()


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_path_does_not_depend_on_how_many_work(friction):
    rec = recording([[0.5, 0.3], [1.0, 0.1], [1.5, 0.0], [1.0, 0.1], [0.2, 0.4]])
    base = robot(friction=friction)
    variants = [
        robot([{"name": "stiffness", "scale": 1.001}], friction=friction),
        robot([{"name": "cable_gain", "scale": 1.001}], friction=friction),
    ]
    found = []
    for count in (1, 3):
        set_workers(count)
        starts: dict = {}
        paths = [DrivenRobot(r, drive_of(r, rec)) for r in (base, *variants)]
        rows = [list(solve_path(paths[0], range(5), attrgetter("markers"), paths[1:], starts=starts)) for _ in range(2)]
        found.append([np.vstack([seen[None], others]) for again in rows for _, _, seen, others in again])
    np.testing.assert_array_equal(found[0], found[1])


def test_work_beside_is_waited_for_and_its_errors_come_with_the_wait():
    set_workers(2)
    done: list[int] = []

    def work() -> None:
        time.sleep(0.05)
        done.append(threading.get_ident())

    with beside(work) as wait:
        wait()
        assert len(done) == 1 and done[0] != threading.get_ident()
    with beside(work):
        pass
    assert len(done) == 2

    def fail() -> None:
        raise DataError("nothing there")

    with pytest.raises(DataError, match="nothing there"), beside(fail) as wait:
        wait()
    with pytest.raises(InputError), beside(work):
        raise InputError("ends early", where="here", found=1, expected="2")
    assert len(done) == 3


def test_one_worker_begins_nothing_beside():
    set_workers(1)
    done: list[int] = []
    with beside(lambda: done.append(1)) as wait:
        wait()
    assert not done
