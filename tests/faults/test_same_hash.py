"""The same study and seed give the same bytes with one worker, with two, and on a dask cluster."""

from __future__ import annotations

import hashlib
import json

import pytest

from tests.faults import cases, forks

pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    import distributed

    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as found:
        yield found.scheduler_address.replace("tcp://", "dask://")


def fingerprint(folder, stage) -> str:
    """A hash of a stage's tables, without the line that names the software."""
    found = hashlib.sha256()
    for name in cases.TABLES[stage]:
        text = (folder / name).read_text()
        if name.endswith(".json"):
            text = json.dumps({k: v for k, v in json.loads(text).items() if k != "software"})
        found.update(text.encode())
    return found.hexdigest()


@pytest.mark.filterwarnings("ignore")  # distributed's own, of its sockets
def test_one_two_and_dask_workers_agree(tmp_path, cluster):
    path = cases.write_study(tmp_path, points=30)
    ways = {"one": (), "two": ("--workers", 2), "dask": ("--executor", cluster)}
    for stage in ("sweep", "fit"):  # fit begins with identify
        for way, options in ways.items():
            forks.run(stage, path, "--out", tmp_path / way, "--seed", 4, *options)
    for stage in ("sweep", "identify", "fit"):
        assert len({fingerprint(tmp_path / way, stage) for way in ways}) == 1, stage
    forks.run("fit", path, "--out", tmp_path / "other", "--seed", 5)
    assert fingerprint(tmp_path / "other", "fit") != fingerprint(tmp_path / "one", "fit")  # the hash sees a difference
