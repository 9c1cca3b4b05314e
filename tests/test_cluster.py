"""The jobs of a batch on a Ray cluster of two simulated machines, one of which dies."""

import shutil
import subprocess
import sys

import pytest
from test_batch import LONG, manifests, manifests_there, run, wait, whole

ray = pytest.importorskip("ray", reason="Ray is an extra: pip install 'torchcmax[cluster]'")


@pytest.fixture
def cluster():
    """Two machines of one core each; the first one holds the cluster together."""
    from ray.cluster_utils import Cluster

    memory = 80 << 20
    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": memory, "include_dashboard": False})
    found.second = found.add_node(num_cpus=1, object_store_memory=memory)
    found.wait_for_nodes()
    yield found
    found.shutdown()


@pytest.mark.slow
def test_a_machine_of_the_cluster_dies_and_nothing_is_lost_or_done_twice(cluster, demo, tmp_path, capsys):
    for name in "abcdef":
        shutil.copytree(demo, tmp_path / "in" / name)
    out = tmp_path / "out"
    words = [tmp_path / "in", *LONG, "--out", out, "--address", cluster.address, "--quiet"]
    command = [sys.executable, "-m", "torchcmax.cli", "batch", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait(lambda: len(list((out / ".running").glob("0*/log.txt"))) >= 2 or manifests_there(out), 120)
    cluster.remove_node(cluster.second, allow_graceful=False)
    said, err = process.communicate(timeout=200)
    assert process.returncode == 0, said + err
    assert "6 finished now, 0 before, 0 failed" in said
    first = manifests(out)
    assert set(first) == set("abcdef")
    assert whole(out)
    status, said, _ = run(capsys, *words[:-3], "--workers", 1, "--quiet")  # the same without the cluster: there is nothing left to do
    assert (status, manifests(out)) == (0, first)
    assert "0 finished now, 6 before" in said


def test_an_address_where_no_cluster_answers_is_wrong_usage(demo, tmp_path, capsys):
    status, _, err = run(capsys, demo, *LONG, "--out", tmp_path / "o", "--address", "auto", "--quiet")
    assert status == 2
    assert "no Ray cluster answers" in err


def test_every_file_of_the_jobs_is_asked_for(tmp_path):
    from torchcmax.cluster import _files, _seen
    from torchcmax.job import Job

    for name in ("a.raw", "c.yaml", "lens.yaml", "word"):
        (tmp_path / name).write_text("hello")
    config = {"camera": "lens.yaml", "map": None}
    options = (f"--config={tmp_path}/c.yaml", "--limit=2")
    jobs = [
        Job(i, "track", tmp_path / f"{x}.raw", x, tmp_path, x, {}, options, config, "", "", home=str(tmp_path)) for i, x in enumerate("ab")
    ]
    files = _files(jobs)
    assert [file.rpartition("/")[2] for file in files] == ["a.raw", "b.raw", "lens.yaml", "c.yaml"]
    assert _seen(str(tmp_path / "word"), files) == ("hello", [str(tmp_path / "b.raw")])
    assert _seen(str(tmp_path / "nothing"), []) == ("", [])
