"""A dask cluster gives what this process gives, and refuses what it cannot do the same way."""

from __future__ import annotations

import pool_jobs
import pytest

from hvdc_ident.errors import InputError
from hvdc_ident.study.executors import open_executor

pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def address():
    import distributed

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address.replace("tcp://", "dask://")


@pytest.mark.filterwarnings("ignore")
def test_values_and_failures_are_those_of_the_local_pool(address):
    job = pool_jobs.Job(fails={7})
    with open_executor(address, 1) as cluster:
        found = {e.index: e for e in cluster.run(job, range(100))}
        assert sorted(found) == list(range(100))
        assert found[7].failure == "ValueError: a bad number"
        assert all(e.value == i * i for i, e in found.items() if i != 7)
        for _ in range(20):  # the same function again and again, as the steps of profiles are sent
            assert list(cluster.map(pool_jobs.Job(), range(5))) == [0, 1, 4, 9, 16]


@pytest.mark.parametrize(
    ("name", "says"),
    [("spark://h:1", "no executor|no such executor"), ("dask://127.0.0.1:9", "no dask scheduler answers")],
)
def test_what_cannot_be_reached_is_said(monkeypatch, name, says):
    monkeypatch.setattr("hvdc_ident.study.dask_executor.CONNECT", 0.5)
    with pytest.raises(InputError, match=says), open_executor(name, 1):
        raise AssertionError
