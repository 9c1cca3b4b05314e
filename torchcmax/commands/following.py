"""Through a whole recording with a tracker, with a progress bar and a last word: what `track` and `panorama` share."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Self

from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax.commands.arguments import folder, recording_of, settings
from torchcmax.track import TrackOptions, Tracks, load_kernels, track
from torchcmax.trackreport import TrackReport


def follow(config: Namespace, options: TrackOptions, kind: type[TrackReport], names: tuple[str, ...]) -> int:
    """Through the whole recording; names: of the options beside those of the tracking that make the same run again."""
    out = folder(config.out)
    recording = recording_of(config, partial(load_kernels, options.slam))
    tracks = track(recording, options)
    text = settings(config, options.slam, names)
    with tracks.stream, kind(out, tracks, text, config.images) as report, Progress(tracks, report, config.quiet) as bar:
        for one in tracks:
            report.add(one)
            bar.update()
    shown = [out / name for name in report.names if name in report.files and Path(name).suffix in (".txt", ".png")]
    print("\n".join([told(report), *(f"{path.stem}: {path}" for path in shown), f"curves: tensorboard --logdir {out}"]))
    return 0


def told(report: TrackReport) -> str:
    """The run in a few words."""
    found, error = report.summary(), report.error
    lost = f"{found['lost_seconds']:g} s lost" + (
        f" ({found['losses']} times, found again {found['recoveries']})" if found["losses"] else ""
    )
    words = f"{found['windows']} windows, {found['keyframes']} keyframes, {lost}, {report.factor:.2f}x real time"
    if error is None:
        return words
    parts = [] if error["percent_of_distance"] is None else [f"{error['percent_of_distance']:.3f} % of the plane's distance"]
    parts += [f"{error['orientation_rmse_deg']:.3f} degrees", f"coverage {error['coverage']:.3f}"]
    return f"{words}\nerror: {', '.join(parts)}"


class Progress:
    """A bar of the recording's seconds, and how many of them a second of work takes."""

    def __init__(self, tracks: Tracks, report: TrackReport, quiet: bool) -> None:
        self._tracks, self._report = tracks, report
        self._bar = tqdm(desc=tracks.recording.name, disable=quiet, bar_format="{desc}: {n:.2f} s [{elapsed}{postfix}]")

    def update(self) -> None:
        """Another window is done."""
        stream, seconds = self._tracks.stream, self._report.seconds
        if stream.share:
            self._bar.bar_format = "{l_bar}{bar}| {n:.2f}/{total:.2f} s [{elapsed}<{remaining}{postfix}]"
            self._bar.total = seconds / (stream.share * self._report.events / stream.consumed)  # some were taken and are still to come
        self._bar.set_postfix_str(f"{self._report.factor:.2f}x real time", refresh=False)
        self._bar.update(seconds - self._bar.n)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
