"""Two hundred small blocks and a lake of fifty files: the same bytes from one process and from one, two and three workers over TCP."""

import numpy as np
import pytest

from baarda.executors import open_workers
from baarda.report.lake_report import run_lake
from test_batch import make_blocks
from test_cluster import Cluster, finish, with_dask
from test_lake import QUICK, folder_bytes

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
pytestmark = pytest.mark.sampling


@with_dask
def test_two_hundred_blocks(tmp_path):
    blocks = make_blocks(tmp_path / "blocks", 200)
    plain = finish(blocks, tmp_path / "plain")
    assert sum(name.endswith("result.json") for name in plain) == 200
    cluster = Cluster(tmp_path / "cluster", 1)
    try:
        for count in (1, 2, 3):
            if count > 1:
                cluster.more(1)
                cluster.wait(count)
            with open_workers(cluster.address) as workers:
                assert workers.count == count
                assert finish(blocks, tmp_path / f"out{count}", workers) == plain, count
    finally:
        cluster.close()


@with_dask
def test_fifty_files(tmp_path):
    lake = tmp_path / "lake"
    lake.mkdir()
    for k in range(50):
        rng = np.random.default_rng(k)
        rows = int(rng.integers(0, 40_000))
        made = {"image": rng.integers(0, 300, rows), "residual": rng.standard_normal(rows, dtype=np.float32)}
        parquet.write_table(pa.table(made), lake / f"{k:03d}.parquet", row_group_size=10_000)
    run_lake(lake, tmp_path / "plain", options=QUICK)
    cluster = Cluster(tmp_path / "cluster", 3)
    try:
        for count in (3, 2, 1):
            while len(cluster.workers) > count:
                gone = cluster.workers.pop()
                gone.terminate()
                gone.wait()
            with open_workers(cluster.address) as workers:
                run_lake(lake, tmp_path / f"out{count}", options=QUICK, workers=workers)
            assert folder_bytes(tmp_path / f"out{count}") == folder_bytes(tmp_path / "plain"), count
    finally:
        cluster.close()
