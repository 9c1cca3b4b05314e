"""Jobs on this machine: processes of one thread each, which go on from job to job and are replaced when they die."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait

from tqdm import tqdm

from torchcmax.job import UNEXPECTED, Job, Manifest, died, work

LEAVE = 10.0  # s that an idle process has to end by itself, and to give back what it holds
ALONE = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "MKL_NUM_THREADS": "1"}  # read when torch is loaded


def locally(jobs: Sequence[Job], workers: int, retries: int, begin: Callable[[Job], None]) -> Iterator[Manifest]:
    """Do all jobs, at most `workers` at a time; manifests in the order in which jobs end.

    A job whose process dies is tried `retries` times more.  Closing the iterator stops all that runs.  begin: told of each attempt.
    """
    waiting, crew, deaths = deque(jobs), list[Worker](), Counter[int]()
    try:
        while waiting or crew:
            while waiting and len(crew) < workers:
                crew.append(Worker())
                crew[-1].give(waiting.popleft(), begin)
            ready = wait([end for worker in crew for end in (worker.pipe, worker.process.sentinel)])
            for worker in [one for one in crew if one.pipe in ready or one.process.sentinel in ready]:
                manifest = worker.answer()
                if manifest is None:
                    deaths[worker.job.number] += 1
                    if deaths[worker.job.number] <= retries:
                        waiting.appendleft(worker.job)
                    else:
                        count = deaths[worker.job.number]
                        yield died(worker.job, worker.obituary(count), worker.process.exitcode or 1, count)
                if manifest is None or manifest["exit"] == UNEXPECTED or not waiting:  # what a fault leaves behind is not for the next
                    worker.rest()
                    crew.remove(worker)
                else:
                    worker.give(waiting.popleft(), begin)
                if manifest is not None:
                    yield manifest
    finally:
        for worker in crew:
            worker.end()


class Worker:
    """A process that does one job after another: torch takes seconds to load."""

    job: Job

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would inherit threads' locks and a CUDA that cannot be used
        self.pipe, far = context.Pipe()
        self.process = context.Process(target=serve, args=(far,), daemon=True)
        with _alone():
            self.process.start()
        far.close()

    def give(self, job: Job, begin: Callable[[Job], None]) -> None:
        """Begin a job."""
        self.job = job
        begin(job)
        try:
            self.pipe.send(job)
        except OSError:  # died in idleness: `answer` will say so
            self.process.join()

    def answer(self) -> Manifest | None:
        """What became of the job; None: the process died of it."""
        try:
            if self.pipe.poll():
                manifest: Manifest = self.pipe.recv()
                return manifest
        except (EOFError, OSError):
            pass
        self.process.join()
        return self.job.finished()

    def obituary(self, deaths: int) -> str:
        """How the process died."""
        code = self.process.exitcode or 0
        try:
            how = f"was killed by {signal.Signals(-code).name}" + (" (out of memory?)" if code == -signal.SIGKILL else "")
        except ValueError:
            how = f"ended with status {code}"
        return f"its process {how}" + (f", {deaths} times" if deaths > 1 else "")

    def rest(self) -> None:
        """Let the process end by itself, as it does when there is nothing more to come."""
        self.pipe.close()
        self.process.join(LEAVE)
        self.end()

    def end(self) -> None:
        """Stop the process, whatever it does."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


@contextmanager
def _alone() -> Iterator[None]:
    """A process begun in here has one thread, and leaves Ctrl-C to its parent from its first moment on."""
    kept = {name: os.environ.get(name) for name in ALONE}
    os.environ.update(ALONE)
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield
    finally:
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if masked is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, masked)


def serve(pipe: Connection) -> None:
    """The life of a worker: jobs come through the pipe, manifests go back."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system's, which a killed process leaves behind
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            pipe.send(work(pipe.recv()))
        except (EOFError, OSError):  # nobody is there any more
            return


def _end_with_parent() -> None:
    """No worker goes on when the process that began it was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
