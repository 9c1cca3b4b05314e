"""Jobs on a Ray cluster: Ray places them, tries them again when a process or a machine dies, and hands out the GPUs."""

from __future__ import annotations

import platform
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchcmax.config import UsageError
from torchcmax.io import DataError
from torchcmax.job import RUNNING, UNEXPECTED, Job, Manifest, died, work

AHEAD = 2  # jobs handed to Ray for each core or GPU of the cluster: enough for an autoscaler to see that there is more to do
REPLY = 120.0  # s that a machine of the cluster has to start a process and look at a file


@dataclass(frozen=True)
class Cluster:
    """Which cluster, and how it is used."""

    address: str = "auto"
    """auto, or ray://HOST:PORT."""
    gpu: bool = False
    """Every job gets a GPU of its own."""
    most: int = 0
    """Jobs handed to Ray at a time; 0: twice as many as the cluster has cores, or GPUs."""
    retries: int = 1
    """How often a job is tried again when its process or machine dies."""


def distributed(jobs: Sequence[Job], cluster: Cluster, begin: Callable[[Job], None]) -> Iterator[Manifest]:
    """Do all jobs on the cluster; manifests in the order in which jobs end.  Closing the iterator stops all that runs."""
    if not jobs:
        return
    ray = _ray()
    with _connected(ray, cluster.address):
        _check_shared(ray, jobs[0].out, _files(jobs))
        if cluster.gpu and not ray.cluster_resources().get("GPU"):
            raise UsageError(f"--device cuda: the Ray cluster at {cluster.address} has no GPU; take --device cpu")
        remote = ray.remote(work).options(num_cpus=1, num_gpus=1 if cluster.gpu else 0, max_retries=cluster.retries, name="torchcmax")
        waiting, running = deque(jobs), dict[Any, Job]()
        try:
            while waiting or running:
                while waiting and len(running) < _most(ray, cluster):
                    job = waiting.popleft()
                    begin(job)
                    running[remote.remote(job)] = job
                for done in ray.wait(list(running), num_returns=1)[0]:
                    yield _result(ray, done, running.pop(done))
        finally:
            for task in running:
                ray.cancel(task, force=True)


def _ray() -> Any:
    """The library, which is an extra."""
    try:
        import ray
    except ImportError as error:
        raise UsageError(f"--address needs Ray ({error}): pip install 'torchcmax[cluster]'") from error
    return ray


@contextmanager
def _connected(ray: Any, address: str) -> Iterator[None]:
    """The cluster, which is somebody else's to start and stop; a connection that is there already stays."""
    ours = not ray.is_initialized()
    if ours:
        try:
            ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, ValueError, RuntimeError) as error:
            problem = " ".join(str(error).split())
            raise UsageError(f"--address {address}: no Ray cluster answers; start one with `ray start --head` ({problem})") from error
    try:
        yield
    finally:
        if ours:
            ray.shutdown()


def _files(jobs: Sequence[Job]) -> list[str]:
    """The recordings of jobs, and the files that their options name."""
    files = dict.fromkeys(str(job.recording) for job in jobs)
    for job in jobs:
        named = [job.config.get("camera") or "pinhole", job.config.get("map") or "pinhole"]
        named += [option.removeprefix("--config=") for option in job.options if option.startswith("--config=")]
        files |= dict.fromkeys(str(Path(job.home, name)) for name in named if name != "pinhole")
    return list(files)


def _check_shared(ray: Any, out: Path, files: list[str]) -> None:
    """Every machine of the cluster sees the folder of the results, where each is asked for the word in a file, and the jobs' files."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    word, file = uuid.uuid4().hex, out / RUNNING / "word"
    file.write_text(word)
    look = ray.remote(_seen)
    nodes = {node["NodeID"]: node["NodeManagerHostname"] for node in ray.nodes() if node["Alive"]}
    asked = {}
    for one in nodes:
        there = NodeAffinitySchedulingStrategy(one, soft=False)
        asked[look.options(num_cpus=0, max_retries=0, scheduling_strategy=there).remote(str(file), files)] = one
    for task, node in asked.items():
        try:
            seen, lacking = ray.get(task, timeout=REPLY)
        except ray.exceptions.RayError as error:
            remedy = "see that torchcmax is installed there, in the same version of Python, and that Ray works"
            raise DataError(out, f"the machine {nodes[node]} of the cluster does not answer: {_first_line(error)}", remedy) from error
        if seen != word:
            remedy = f"give an --out on a file system that all machines share, by the same name as on {platform.node()}"
            raise DataError(out, f"is not seen from {nodes[node]}, a machine of the cluster", remedy)
        if lacking:
            more = f", nor are {len(lacking) - 1} others" if len(lacking) > 1 else ""
            remedy = f"put it on a file system that all machines share, by the same name as on {platform.node()}"
            raise DataError(lacking[0], f"is not seen from {nodes[node]}, a machine of the cluster{more}", remedy)


def _seen(file: str, others: list[str]) -> tuple[str, list[str]]:
    """What a file holds, as seen from here, empty where it is not there; and which others are not there."""
    lacking = [other for other in others if not Path(other).exists()]
    try:
        return Path(file).read_text(), lacking
    except OSError:
        return "", lacking


def _most(ray: Any, cluster: Cluster) -> int:
    """How many jobs Ray has at a time: the rest waits here, since a cluster may shrink and grow."""
    return cluster.most or max(AHEAD, AHEAD * int(ray.cluster_resources().get("GPU" if cluster.gpu else "CPU", 1)))


def _result(ray: Any, done: Any, job: Job) -> Manifest:
    """The manifest of a job that ended, or that Ray gave up."""
    try:
        manifest: Manifest = ray.get(done)
        return manifest
    except ray.exceptions.RayError as error:
        return job.finished() or died(job, f"{type(error).__name__}: {_first_line(error)}", UNEXPECTED)


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "")
