"""torchcmax batch: many recordings, on this machine or on a cluster."""

from __future__ import annotations

import dataclasses
import json
import sys
import uuid
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from jsonargparse import Namespace
from jsonargparse.typing import Path_fr
from tqdm import tqdm

from torchcmax import batch
from torchcmax.batchpage import write_batch_page
from torchcmax.cluster import Cluster, distributed
from torchcmax.commands import compensate, panorama, track
from torchcmax.commands.arguments import available_cores, check_device, folder, made, opening
from torchcmax.compensate import Compensation
from torchcmax.config import Parser, UsageError, parser, usage
from torchcmax.job import TASKS, Job, Manifest
from torchcmax.slam.system import Panorama, Slam
from torchcmax.track import TrackOptions
from torchcmax.workers import locally

SUMMARY = "do a task with many recordings, on many cores, a GPU or a Ray cluster; only what is missing or failed"
OURS = ("recording", "out", "config", "quiet", "threads", "device", "help")  # options of a job that the batch gives
MODULES = {"compensate": compensate, "track": track, "panorama": panorama}


def build() -> Parser:
    """Its options.  --config is for the task, so this is no parser of `command`."""
    sub = Parser(
        description="Do a task with many recordings. Each result is a folder of --out, which appears when it is whole, with manifest.json "
        "and log.txt; what fails goes to a folder NAME.failed and does not stop the others. The same command again does only what is "
        "missing or failed. Writes batch.csv, batch.json and report.html on all results."
    )
    sub.add_argument("recordings", type=str, nargs="+", help="recordings, or folders to be searched for them")
    sub.add_argument("--task", type=str, choices=TASKS, required=True, help="what to do with each: one of " + ", ".join(TASKS))
    sub.add_argument("--out", type=str, required=True, help="folder to write; look at it with: tensorboard --logdir DIR")
    sub.add_argument("--config", type=Path_fr, action="append", help="YAML file with options of the task; can be given again")
    sub.add_argument("--set", type=str, action="append", metavar="KEY=VALUE", help="an option of the task, for all; can be given again")
    values = "run with each of these values; can be given again: all combinations"
    sub.add_argument("--sweep", type=str, action="append", metavar="KEY=A,B,C", help=values)
    sub.add_argument("--device", type=str, default="", help="cpu or cuda, instead of what the configuration says")
    sub.add_argument("--workers", type=int, default=0, help="jobs at a time; 0: one for each core, or one on a GPU")
    sub.add_argument("--address", type=str, default="", help="of a Ray cluster to run on: auto, or ray://HOST:PORT")
    sub.add_argument("--retries", type=int, default=1, help="how often a job is tried again whose process or machine died")
    sub.add_argument("--again", action="store_true", help="do also what is done already, and replace it")
    sub.add_argument("--quiet", action="store_true", help="no progress bar")
    return sub


def run(config: Namespace) -> int:
    """torchcmax batch"""
    out = folder(config.out).resolve()
    for name in ("workers", "retries"):
        if config[name] < 0:
            raise UsageError(f"--{name} wants a number of at least 0, got {config[name]}")
    settings = [(one, options, understood(config, options)) for one, options in _settings(config)]
    recordings, skipped = batch.found(config.recordings, out)
    if skipped and not config.quiet:
        more = f" and {len(skipped) - 5} more" if len(skipped) > 5 else ""
        print(f"no recordings, so left out: {', '.join(path.name for path in skipped[:5])}{more}", file=sys.stderr)
    jobs = _jobs(config, recordings, settings, out)
    left = batch.missing(jobs)
    with batch.claimed(out):
        try:
            left = batch.missing(jobs)  # another run may just have ended
            done = _go(left, config, str(settings[0][2]["device"]))
        finally:
            rows = batch.results(out, jobs)
            batch.write_tables(out, rows)
    page = write_batch_page(out, rows) if rows else None
    return _told(jobs, left, done, out, page)


def _settings(config: Namespace) -> Iterator[tuple[dict[str, str], tuple[str, ...]]]:
    """Each combination of the sweep, with the options of the command line that make it."""
    fixed = [f"--config={Path(file.absolute)}" for file in config.config or ()]
    pairs = [text.partition("=") for text in config.set or ()]
    if wrong := [f"{key}{sign}{value}" for key, sign, value in pairs if not key or not sign]:
        raise UsageError(f"--set wants key=value, got {wrong[0]!r}")
    fixed += [f"--device={config.device}"] if config.device else []
    for one in batch.swept(config.sweep or ()):
        if ours := [key for key in (*one, *(pair[0] for pair in pairs)) if key in OURS]:
            raise UsageError(f"{ours[0]} cannot be set for single jobs of a batch: see its own options")
        yield one, (*fixed, *(f"--{key}={value}" for key, _, value in pairs), *(f"--{key}={value}" for key, value in one.items()))


def understood(config: Namespace, options: Sequence[str]) -> dict[str, Any]:
    """The settings of a task as it understands them; whatever is wrong with them is said now, before any work."""
    task = config.task
    line = parser("torchcmax", "")
    line.add_subcommands(required=True, dest="command").add_subcommand(task, MODULES[task].build())
    found = line.parsed([task, "recording", "--out", "out", *options])[task]
    opening(found)
    if task == "compensate":
        made(Compensation, found)
    else:
        slam: Slam | Panorama = made(Slam, found) if task == "track" else made(Panorama, found)
        with usage():
            TrackOptions(slam, found["from"], found.to, found.get("distance"), found.map, found.device)
    if config.address and found.device.startswith("cuda:"):
        raise UsageError(f"--device {found.device}: which GPU a job gets is Ray's to say; give --device cuda")
    if not config.address:
        check_device(found.device)
    if found.images < 0:
        raise UsageError(f"images wants a number of at least 0, got {found.images}")
    kept: dict[str, Any] = {name: _plain(value) for name, value in vars(found).items() if name not in OURS or name == "device"}
    return kept


def _plain(value: Any) -> Any:
    """A setting as JSON has it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    return json.loads(json.dumps(value, default=str))


def _jobs(config: Namespace, recordings: list[Path], settings: list[tuple[Any, ...]], out: Path) -> list[Job]:
    """Every recording under every setting; for one recording after the other, so that a sweep finds it in memory."""
    names, run = batch.named(recordings), uuid.uuid4().hex
    hashes = [batch.config_hash(config.task, whole) for *_, whole in settings]
    return [
        Job(
            number=i * len(settings) + k,
            task=config.task,
            recording=recording,
            name=names[recording],
            out=out,
            folder="/".join([*([batch.folder_of(one)] if one else []), names[recording]]),
            settings=one,
            options=options,
            config=whole,
            config_hash=hashes[k],
            batch=run,
            again=config.again,
            home=str(Path.cwd()),
        )
        for i, recording in enumerate(recordings)
        for k, (one, options, whole) in enumerate(settings)
    ]


def _go(jobs: list[Job], config: Namespace, device: str) -> list[Manifest]:
    """Do the jobs, and tell of each that fails."""
    gpu = device.startswith("cuda")
    done: list[Manifest] = []
    going: dict[str, None] = {}
    with tqdm(total=len(jobs), unit="job", desc="batch", disable=config.quiet) as bar:

        def begin(job: Job) -> None:
            going[job.folder] = None
            bar.set_postfix_str(", ".join(list(going)[-3:]))

        if config.address:
            ended = distributed(jobs, Cluster(config.address, gpu, config.workers, config.retries), begin)
        else:
            ended = locally(jobs, config.workers or (1 if gpu else min(available_cores(), len(jobs))), config.retries, begin)
        with closing(ended):  # type: ignore[type-var]
            for manifest in ended:
                done.append(manifest)
                going.pop(manifest["folder"], None)
                if manifest["exit"]:
                    bar.write(f"failed: {manifest['folder']}: {manifest['error']}", file=sys.stderr)
                bar.update()
    return done


def _told(jobs: list[Job], left: list[Job], done: list[Manifest], out: Path, page: Path | None) -> int:
    """What became of it; -> the exit status."""
    failed = [manifest for manifest in done if manifest["exit"]]
    before = len(jobs) - len(left)
    print(f"{len(jobs)} results: {len(done) - len(failed)} finished now, {before} before, {len(failed)} failed")
    for manifest in failed:
        print(f"  {manifest['folder']}: {manifest['error']}\n    {out / (manifest['folder'] + '.failed') / 'log.txt'}")
    print(f"table: {out / batch.TABLE}" + (f"\npage: {page}" if page else "") + f"\ncurves: tensorboard --logdir {out}")
    return 1 if failed else 0
