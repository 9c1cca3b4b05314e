"""A result against ground truth, by named protocols."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchcmax.alignment import WANTED, Statistics, absolute, evo_absolute, evo_relative, laid
from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.folder import EVALUATION, SUMMARY, versions, writing
from torchcmax.io import DataError, DataNote, DataWarning
from torchcmax.io.errors import tell
from torchcmax.io.trajectory import TUM, read_trajectory
from torchcmax.protocols import PROTOCOLS, Protocol
from torchcmax.resultfiles import Result, inside, read_result
from torchcmax.score import GAP, Similarity, common, coverage, errors, path_length, rotation, similarity
from torchcmax.score import inside as inside_truth
from torchcmax.velocity import Velocities, true_velocities, velocity_errors, within

ALL = ("all",)  # the protocols that can judge a run, by themselves
ESTIMATE = "estimate"  # the word for an offset that is looked for
REACH, COARSE, FINE = 1_000_000, 5_000, 20  # µs: offsets looked for, and how finely
ENOUGH = 2000  # poses that an offset is looked for with
CLEAR, WIDE = 1.2, 100_000  # offsets that fit worse than the best by at most this factor, and how far apart, µs, they may be
EVER = 1 << 62  # µs; beyond all times
TURNED = 5.0  # °; so far from where orientations lay the world, positions that lay it otherwise are told of
Row = dict[str, Any]


@dataclass(frozen=True)
class EvaluateOptions:
    """How results are judged."""

    delta: float = 1.0
    """Seconds between the two poses that relative errors (RPE) compare."""
    align_at: float | None = None
    """Second of the recording's clock whose pose is laid on the truth's, by first_pose and cmax_slam; default: the first pose."""
    offset: str = "0"
    """Seconds to add to the result's times to have the truth's; the word estimate looks for them within a second."""
    smooth: float = 0.0
    """Seconds, at least, over which the truth's velocity is the mean, for truth too rough for single windows."""
    extrinsic: str = ""
    """Where the truth is of a body, as EuRoC's is: the camera's pose in it, "tx ty tz qx qy qz qw"."""
    begin: float | None = None
    """Second of the recording's clock to begin at."""
    end: float | None = None
    """Second of the recording's clock to stop before."""

    def __post_init__(self) -> None:
        if not 0 < self.delta < 1e6:
            raise ValueError(f"--delta wants seconds above 0, got {self.delta}")
        if not 0 <= self.smooth < 1e6:
            raise ValueError(f"--smooth wants seconds of at least 0, got {self.smooth}")
        if self.begin is not None and self.end is not None and self.begin >= self.end:
            raise ValueError(f"--from must come before --to, got {self.begin} and {self.end}")
        if self.offset != ESTIMATE:
            _number("--offset", self.offset)
        self.camera()

    def camera(self) -> Pose:
        """The camera's pose [] in the body of the truth."""
        if not self.extrinsic:
            return Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
        numbers = torch.tensor([_number("--extrinsic", word) for word in self.extrinsic.replace(",", " ").split()], dtype=torch.float64)
        if len(numbers) != 7 or abs(float(numbers[3:].norm()) - 1) > 0.01:
            raise ValueError(f"--extrinsic wants tx ty tz qx qy qz qw with a quaternion of length 1, got {self.extrinsic!r}")
        return Pose(so3.from_quaternion(numbers[3:]), numbers[:3])


def _number(option: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e6:
        raise ValueError(f"{option} wants numbers, got {text!r}")
    return value


@dataclass(frozen=True)
class Run:
    """What is judged: what a run of ours left in its folder, or a trajectory of anybody's.

    recording: where its truth may be | trajectory: T_wc in a world of its own, None where there is none | turning: its positions mean
    nothing | metric: they are metres | plane [1]: of that world | span: µs from its first window to its last, None where nobody knows
    """

    name: str
    place: Path
    recording: Path | None = None
    trajectory: Trajectory | None = None
    turning: bool = False
    metric: bool = False
    plane: Plane | None = None
    velocities: Velocities | None = None
    span: tuple[int, int] | None = None

    @property
    def usual(self) -> tuple[str, ...]:
        """The protocols where none are asked for, all without evo."""
        first = () if self.trajectory is None else ("rotation",) if self.turning else ("similarity",)
        return first if self.velocities is None else (*first, "velocity")

    def lacks(self, protocol: Protocol) -> str:
        """Why a protocol cannot judge it; empty where it can."""
        if protocol.align is None:
            return "" if self.velocities is not None else "it has no windows with velocities"
        if self.trajectory is None:
            return "it has no trajectory"
        return "it has orientations only" if self.turning and not protocol.turning else ""


def read_run(path: Path) -> Run:
    """A folder that `compensate`, `track` or `panorama` wrote, or a trajectory as text: TUM."""
    if path.is_file():
        return Run(path.stem, path, trajectory=read_trajectory(path), metric=True)
    if not path.is_dir():
        raise DataError(path, "there is no such folder or file", f"give a folder with {SUMMARY}, or a trajectory of lines {TUM}")
    result = read_result(path)
    summary, poses = result.summary, inside(path, "trajectory.txt") if result.task != "compensate" else None
    trajectory = None if poses is None else read_trajectory(poses)
    distance = result.config.get("distance")
    unit = float(distance) if isinstance(distance, int | float) else 1.0
    times = [int(result.numbers[name][i]) for name, i in (("start_us", 0), ("end_us", -1))] if len(result.numbers["start_us"]) else None
    return Run(
        str(summary.get("recording") or path.resolve().name),
        path,
        Path(str(summary["path"])) if summary.get("path") else None,
        trajectory,
        turning=summary.get("model") == "rotation",
        metric=distance is not None,
        plane=_plane(summary.get("plane"), unit),
        velocities=_velocities(result, trajectory, unit),
        span=None if times is None else (times[0], times[1]),
    )


def _plane(told: Any, unit: float) -> Plane | None:
    """The plane that a summary tells."""
    if not isinstance(told, dict) or not {"normal", "distance"} <= set(told):
        return None
    return Plane(torch.tensor([told["normal"]], dtype=torch.float64), torch.tensor([told["distance"] * unit], dtype=torch.float64))


def _velocities(result: Result, trajectory: Trajectory | None, unit: float) -> Velocities | None:
    """Of the windows in the table that have them; of a tracked camera, those on the main map."""
    column = {name: torch.from_numpy(values) for name, values in result.numbers.items()}
    omega, linear = (torch.stack([column[f"{name}_{axis}"] for axis in "xyz"], -1) for name in ("omega", "v"))
    keep = omega.isfinite().all(-1)
    tracked = "time_us" in column
    at = column["time_us" if tracked else "start_us"].nan_to_num().long()
    if tracked:
        keep &= torch.zeros_like(keep) if trajectory is None else torch.isin(at, trajectory.time)
        keep &= torch.tensor([status != "lost" for status in result.texts["status"]], dtype=torch.bool)
    if not keep.any():
        return None
    moves = result.summary.get("model") != "rotation" and bool(linear[keep].isfinite().all())
    start, end = (column[name].long() for name in ("start_us", "end_us"))
    return Velocities(start, end, at, omega, linear * (unit if tracked else 1.0) if moves else None, tracked)[keep]


@dataclass(frozen=True)
class Evaluation:
    """rows: one for each protocol, flat, None where there is no such number | truth: where it stands | offset s, added to the result's
    times | found: whether that was looked for
    """

    rows: list[Row]
    truth: Path
    offset: float
    found: bool

    def save(self, folder: Path) -> None:
        """evaluation.json and evaluation.csv."""
        told = {"truth": str(self.truth), "offset_s": self.offset, "offset_found": self.found, "results": self.rows, "versions": versions()}
        for name, write in zip(EVALUATION, (lambda p: p.write_text(json.dumps(told, indent=1) + "\n"), self.write_csv), strict=True):
            with writing(folder / name) as temporary:
                write(temporary)

    def write_csv(self, path: Path) -> None:
        write_csv(path, self.rows)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line a row, with all columns that any of them has."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, columns)
        table.writeheader()
        table.writerows(rows)


def evaluate(
    run: Run, truth: Trajectory, plane: Plane | None, where: Path, names: Sequence[str] = (), options: EvaluateOptions | None = None
) -> Evaluation:
    """A run against the truth, T_wb in metres, and its plane [1] in the same world.

    names: of protocols in `PROTOCOLS`; none: the usual ones; `ALL`: those that can judge it, a note tells why one cannot
    DataError where a protocol cannot judge the run, or nothing of it lies within the truth's time
    """
    options = options or EvaluateOptions()
    if not run.usual:
        raise DataError(run.place, "holds neither a trajectory nor velocities of windows", "wait for the run's end, or run it again")
    truth = Trajectory(truth.time, truth.pose @ options.camera())
    _tell_gaps(truth, where)
    try:
        asked = _asked(run, options)
        offset = _find_offset(run, truth, asked) if options.offset == ESTIMATE else round(float(options.offset) * 1e6)
        span = common(truth, *(None if abs(time) >= EVER else time + offset for time in asked))
        case = _Case(run, truth, plane, span, offset, options)
        rows = case.all() if names == ALL else [case.row(name) for name in names or run.usual]
    except ValueError as error:
        raise DataError(
            run.place, f"cannot be judged: {error}", "check the clocks, --offset, --from and --to, or take another protocol"
        ) from error
    except ImportError as error:
        raise DataError(run.place, f"wants evo for this protocol: {error}", WANTED) from error
    return Evaluation(rows, where, offset * 1e-6, options.offset == ESTIMATE)


def _asked(run: Run, options: EvaluateOptions) -> tuple[int, int]:
    """The time that is to be judged, µs of the run's clock: of its windows, and --from and --to."""
    first, last = run.span or (-EVER, EVER)
    begin, end = (None if second is None else round(max(-1e12, min(second, 1e12)) * 1e6) for second in (options.begin, options.end))
    return first if begin is None else max(first, begin), last if end is None else min(last, end)


def _tell_gaps(truth: Trajectory, where: Path) -> None:
    gaps = truth.time.diff()
    if (gaps > GAP).any():
        i = int(gaps.argmax())
        text = f"{where}: {int((gaps > GAP).sum())} gaps of more than {GAP * 1e-6:g} s, the longest of {gaps[i] * 1e-6:.3g} s at "
        text += f"{truth.time[i] * 1e-6:.6f} s; poses there are compared with a straight line"
        tell(DataWarning(text))


@dataclass(frozen=True)
class _Case:
    """One run, and what it is judged by; offset: µs that its times are put forward."""

    run: Run
    truth: Trajectory
    plane: Plane | None
    span: tuple[int, int]
    offset: int
    options: EvaluateOptions

    def all(self) -> list[Row]:
        """By every protocol that can judge the run; ValueError where none can."""
        rows, wrong = [], "no protocol can judge it"
        for name, protocol in PROTOCOLS.items():
            if self.run.lacks(protocol):
                continue
            try:
                rows.append(self.row(name))
            except ValueError as error:
                wrong = str(error)
                tell(DataNote(f"{self.run.place}: {name} cannot judge it: {wrong}"))
        if not rows:
            raise ValueError(wrong)
        return rows

    def row(self, name: str) -> Row:
        """By one protocol."""
        protocol = PROTOCOLS[name]
        if lack := self.run.lacks(protocol):
            raise DataError(self.run.place, f"the protocol {name} cannot judge it: {lack}", f"take --protocol {','.join(self.run.usual)}")
        head = {"result": self.run.name, "protocol": name, "from_s": self.span[0] * 1e-6, "to_s": self.span[1] * 1e-6}
        head["offset_s"] = self.offset * 1e-6
        return head | (self._velocity() if protocol.align is None else self._poses(protocol, protocol.align))

    def _kept(self) -> Trajectory:
        assert self.run.trajectory is not None
        moved = Trajectory(self.run.trajectory.time + self.offset, self.run.trajectory.pose)
        return inside_truth(moved, self.truth, *self.span)

    def _poses(self, protocol: Protocol, align: str) -> Row:
        kept = self._kept()
        there = self.truth.at(kept.time)
        at = self._index(kept.time)
        scale = self._metres(kept.pose, there) if align in ("se3", "pose") and not protocol.turning else 1.0
        best = laid(align, kept.pose, there, scale, at)
        position, turn = (evo_absolute if protocol.evo else absolute)(kept, self.truth, best)
        if align in ("sim3", "se3"):
            self._tell_turned(align, best, rotation(kept.pose, there))
        row: Row = {"poses": len(kept), "coverage": coverage(kept.time, self.span)}
        if not protocol.turning:
            row |= {"scale": best.scale.item()} | _named("ate", position, "m")
            length = path_length(self.truth, self.span)
            row["percent_of_path"] = 100 * position["rmse"] / length if length > 0 else None
            row["percent_of_distance"] = None if self.plane is None else 100 * position["rmse"] / self.plane.distance[0].item()
        row |= _named("rotation", turn, "deg")
        if protocol.evo:
            pairs, position, turn = evo_relative(kept, self.truth, best, round(self.options.delta * 1e6))
            row |= {"rpe_delta_s": self.options.delta, "rpe_pairs": pairs}
            if not pairs:
                tell(DataNote(f"{self.run.place}: no pose has one {self.options.delta:g} s later (--delta): no relative errors"))
            row |= {} if protocol.turning else _named("rpe_translation", position, "m")
            row |= _named("rpe_rotation", turn, "deg")
        return row

    def _tell_turned(self, name: str, positions: Similarity, orientations: Similarity) -> None:
        """Positions close to a line hardly hold the rotation about it: only the orientations show that it is wrong."""
        apart = math.degrees(float(so3.log(orientations.R.mT @ positions.R).norm()))
        if apart > TURNED:
            text = (
                f"{self.run.place}: {name} turns the world by {apart:.1f} degrees from where orientations lay it; the path is too close to "
            )
            tell(DataWarning(f"{text}a line, or the truth is not of the camera (--extrinsic): rotation errors are of that, not of the run"))

    def _index(self, time: Tensor) -> int:
        """Of the pose that is laid on the truth's."""
        if self.options.align_at is None:
            return 0
        apart = (time - (round(self.options.align_at * 1e6) + self.offset)).abs()
        if apart.min() > GAP:
            raise ValueError(f"it has no pose at --align_at {self.options.align_at:g} s, the next is {apart.min() * 1e-6:.3g} s away")
        return int(apart.argmin())

    def _metres(self, pose: Pose, there: Pose) -> float:
        """Metres per unit of the positions: 1, or by the plane's distance at the first pose."""
        if self.run.metric:
            return 1.0
        if self.plane is None or self.run.plane is None:
            raise ValueError("its positions are plane distances, and the truth has no plane to tell how long they are")
        return float(self.plane.seen_from(there).distance[0] / self.run.plane.seen_from(pose).distance[0])

    def _velocity(self) -> Row:
        assert self.run.velocities is not None
        smooth = round(self.options.smooth * 1e6)
        kept = within(self.run.velocities.later(self.offset), self.truth, self.span, smooth)
        if not len(kept):
            raise ValueError("none of its windows lies within the truth's time")
        scale = 1.0 if self.run.metric else None
        if scale is None and kept.world and kept.linear is not None:
            poses = self._kept()
            scale = similarity(poses.pose, self.truth.at(poses.time)).scale.item()
        seen = float((kept.end - kept.start).sum()) / (self.span[1] - self.span[0])
        return {"coverage": min(seen, 1.0)} | velocity_errors(kept, self.truth, self.plane, scale, smooth)


def _named(name: str, statistics: Statistics, unit: str) -> Row:
    return {f"{name}_{statistic}_{unit}": value for statistic, value in statistics.items()}


def _find_offset(run: Run, truth: Trajectory, asked: tuple[int, int]) -> int:
    """What is to be added to the run's times, µs, so that what is asked of it fits the truth best; ValueError where nothing tells."""
    cost = _pose_cost(run, run.trajectory, truth, asked) if run.trajectory is not None else _velocity_cost(run, truth, asked)
    shifts = torch.arange(-REACH, REACH + 1, COARSE)
    costs = torch.tensor([cost(int(shift)) for shift in shifts], dtype=torch.float64)
    known = costs.isfinite().nonzero()[:, 0]
    if len(known) < 3:
        raise ValueError("too little of it lies within the truth's time to look for an offset")
    best = int(known[costs[known].argmin()])
    if best in (int(known[0]), int(known[-1])):
        raise ValueError(f"no offset within {shifts[known[0]] * 1e-6:g}..{shifts[known[-1]] * 1e-6:g} s fits better than those around")
    near = shifts[known[costs[known] <= CLEAR * costs[best] + 1e-9]]
    if near[-1] - near[0] > WIDE:
        text = "it moves too evenly, or fits too badly, to tell an offset of time: "
        raise ValueError(f"{text}offsets of {near[0] * 1e-6:g}..{near[-1] * 1e-6:g} s fit about as well")
    return _lowest(cost, int(shifts[best]) - COARSE, int(shifts[best]) + COARSE)


def _pose_cost(run: Run, trajectory: Trajectory, truth: Trajectory, asked: tuple[int, int]) -> Callable[[int], float]:
    """Error after the best alignment: orientations in rad, and positions as a share of how far the truth's spread."""
    keep = (trajectory.time >= asked[0]) & (trajectory.time <= asked[1])
    keep &= (trajectory.time >= truth.time[0] - REACH) & (trajectory.time <= truth.time[-1] + REACH)
    time, pose = trajectory.time[keep], trajectory.pose[keep]
    step = max(1, -(-len(time) // ENOUGH))
    time, pose = time[::step], pose[::step]
    align = rotation if run.turning else similarity
    now = time[(time >= truth.time[0]) & (time <= truth.time[-1])]
    least = max(3, len(now) // 2)
    place = truth.at(now).t
    spread = (place - place.mean(0)).square().sum(-1).mean().sqrt()

    def cost(shift: int) -> float:
        keep = (time + shift >= truth.time[0]) & (time + shift <= truth.time[-1])
        if int(keep.sum()) < least:
            return float("inf")
        moved = Trajectory(time[keep] + shift, pose[keep])
        position, turn = errors(moved, truth, align(moved.pose, truth.at(moved.time)))
        far = position.square().mean().sqrt() / spread if not run.turning and spread > 0 else torch.zeros(())
        return float(torch.deg2rad(turn).square().mean().sqrt() + far)

    return cost


def _velocity_cost(run: Run, truth: Trajectory, asked: tuple[int, int]) -> Callable[[int], float]:
    """Error of the angular velocities, as a share of both, so that a moment at which nothing turns is not the best."""
    assert run.velocities is not None
    velocities = run.velocities[(run.velocities.start >= asked[0]) & (run.velocities.end <= asked[1])]
    least = max(3, len(within(velocities, truth, common(truth))) // 2)

    def cost(shift: int) -> float:
        moved = within(velocities.later(shift), truth, common(truth))
        if len(moved) < least:
            return float("inf")
        found, there = moved.omega, true_velocities(moved, truth)[0]
        return float((found - there).norm() / torch.hypot(found.norm(), there.norm()))  # nan where neither turns

    return cost


def _lowest(cost: Callable[[int], float], low: int, high: int) -> int:
    """Where the cost is lowest between two shifts, by golden section, to FINE µs."""
    ratio = (5**0.5 - 1) / 2
    a, b = float(low), float(high)
    c, d = b - ratio * (b - a), a + ratio * (b - a)
    at_c, at_d = cost(round(c)), cost(round(d))
    while b - a > FINE:
        if at_c < at_d:
            b, d, at_d = d, c, at_c
            c = b - ratio * (b - a)
            at_c = cost(round(c))
        else:
            a, c, at_c = c, d, at_d
            d = a + ratio * (b - a)
            at_d = cost(round(d))
    return round((a + b) / 2)
