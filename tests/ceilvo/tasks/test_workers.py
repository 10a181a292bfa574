"""The same work by one process, by several, and by a Dask cluster; workers that are killed cost their task only."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import task_work
from dask_cluster import cluster
from patience import until

from ceilvo.errors import CeilvoError
from ceilvo.tasks.workers import Workers, each

SEEDS = list(range(8))
NOWHERE = "tcp://127.0.0.1:1"

with_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="Dask is not installed: pip install 'ceilvo[cluster]'"
)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with cluster(tmp_path_factory.mktemp("cluster")) as address:
        yield address


def numbers(workers: Workers) -> tuple[set[int], list[list[float]]]:
    """Who worked, and the results in order."""
    done = dict(each(task_work.drawn, SEEDS, workers))
    return {done[k][0] for k in done}, [done[k][1] for k in range(len(SEEDS))]


def test_several_processes_give_the_bits_of_one() -> None:
    (here,), alone = numbers(Workers())
    others, spread = numbers(Workers(jobs=2))
    assert here == os.getpid() not in others and 1 <= len(others) <= 2
    assert spread == alone


@with_dask
def test_a_cluster_gives_the_bits_of_one_process(scheduler: str) -> None:
    others, spread = numbers(Workers(scheduler=scheduler))
    assert os.getpid() not in others and 1 <= len(others) <= 2
    assert spread == numbers(Workers())[1]


def test_a_process_that_is_killed_costs_its_task_only(tmp_path: Path) -> None:
    items = [(tmp_path, k) for k in range(6)]
    done = list(each(task_work.dies_once, items, Workers(jobs=2)))
    assert sorted(done) == [(k, k) for k in range(6)]
    assert len(list(tmp_path.glob("[0-9].*"))) <= 8  # two were at work at most when one died


@with_dask
def test_a_worker_that_is_killed_costs_its_task_only(scheduler: str, tmp_path: Path) -> None:
    mark, killed = tmp_path / "waiting", []

    def kill() -> None:
        until(mark.exists, "the worker at its task")
        killed.append(int(mark.read_text()))
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    items = [(tmp_path, k) for k in range(6)]
    done = list(each(task_work.waits_to_be_killed, items, Workers(scheduler=scheduler)))
    killer.join()
    assert sorted(done) == [(k, k) for k in range(6)] and killed
    again = [p for p in tmp_path.glob("1.*") if not p.name.endswith(f".{killed[0]}")]
    assert len(again) == 1


def test_work_that_kills_every_process_is_given_up() -> None:
    with pytest.raises(CeilvoError, match=r"3 processes died one after the other .* 2 of 2 are left"):
        list(each(task_work.always_dies, [0, 1], Workers(jobs=2)))


@with_dask
def test_what_work_raises_comes_through(scheduler: str) -> None:
    for workers in (Workers(), Workers(jobs=2), Workers(scheduler=scheduler)):
        with pytest.raises(ValueError, match="item 3 is bad"):
            list(each(task_work.fails, [3], workers))


@with_dask
def test_no_scheduler_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ceilvo.tasks.cluster.CONNECT_S", 0.5)
    for address in (NOWHERE, "nonsense"):
        with pytest.raises(CeilvoError, match=f"--scheduler {address}: no Dask scheduler answers"):
            list(each(task_work.drawn, [1], Workers(scheduler=address)))


@with_dask
def test_a_scheduler_without_workers_and_workers_of_another_version(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ceilvo.tasks.cluster.__version__", "99.0")
    with pytest.raises(
        CeilvoError, match=r"worker tcp://.* has ceilvo .*, expected 99.0; results would not be the same"
    ):
        list(each(task_work.drawn, [1], Workers(scheduler=scheduler)))
    monkeypatch.setattr("ceilvo.tasks.cluster.CONNECT_S", 0.5)
    with cluster(tmp_path, workers=0) as empty, pytest.raises(CeilvoError, match="it has no worker; start some"):
        list(each(task_work.drawn, [1], Workers(scheduler=empty)))


def test_without_dask_it_is_said_and_one_process_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ceilvo.tasks.cluster.find_spec", lambda name: None)
    with pytest.raises(CeilvoError, match=r"pip install 'ceilvo\[cluster\]'"):
        list(each(task_work.drawn, [1], Workers(scheduler=NOWHERE)))
    assert "distributed" not in sys.modules or numbers(Workers())
    assert numbers(Workers())[0] == {os.getpid()}
