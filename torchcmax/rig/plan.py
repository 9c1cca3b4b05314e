"""What the drives will be told, what the motors will need for it, and whether all of that is allowed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from torchcmax.rig import profiles, program
from torchcmax.rig.axis import Chain, drivable, from_quadcounts, quadcounts, quantum
from torchcmax.rig.checks import Check, Track, check
from torchcmax.rig.config import COUNTS, Axis, Bus, Rig
from torchcmax.rig.demand import Samples, samples
from torchcmax.rig.errors import Refused
from torchcmax.rig.profiles import Dwell, Profile, cruise, rise
from torchcmax.rig.program import Program

REST, REST_SYNCS = 0.02, 10  # s, SYNCs, the longer of which lies between two moves of an axis
LONGEST = 3600.0  # s, of one cycle
APPROACH = 0.25  # of the limits, with which an axis goes to where the next step begins

Step = Mapping[int, Profile]  # what axes do, by their index in the rig, beginning on one SYNC


@dataclass(frozen=True)
class Plan:
    """One cycle as the drives run it: program, tracks [axes], samples [K, axes] at every SYNC; checks, of `cycles` of them.

    image_speed: px/s at the image's centre where it is fastest, None where the rig's file does not give focal length and distance
    """

    rig: Rig
    program: Program
    tracks: tuple[Track, ...]
    samples: Samples
    cycles: int
    checks: tuple[Check, ...]
    image_speed: float | None

    @property
    def ok(self) -> bool:
        return all(check.ok for check in self.checks)

    def refuse(self) -> None:
        """Refused where any check failed."""
        failed = [str(check) for check in self.checks if not check.ok]
        if failed:
            remedy = "move slower, with less acceleration, or farther from the ends; or correct the rig's file"
            raise Refused("the plan is not accepted:\n  " + "\n  ".join(failed) + f"\n  what to do: {remedy}")

    def summary(self) -> dict[str, Any]:
        """For plan.json: everything but the samples; what is infinite is None."""
        found = {
            "rig": self.rig.name,
            "configuration": self.rig.digest,
            "ok": self.ok,
            "cycles": self.cycles,
            "image_speed_px_s": self.image_speed,
            "axes": [axis.name for axis in self.rig.axes],
            "program": asdict(self.program),
            "checks": [asdict(check) for check in self.checks],
        }
        plain: dict[str, Any] = _finite(found)
        return plain


def plan(rig: Rig, steps: Sequence[Step], cycles: int = 1) -> Plan:
    """Lays the steps out on the grid of the SYNC, and checks them; whether they are allowed says `ok`."""
    layout = _Layout(rig, steps)
    for step in steps:
        layout.approach(step)
        layout.run(step)
    if not layout.moves:
        raise Refused("the profile moves nothing\n  what to do: give it a step that ends elsewhere than it begins")
    moves = tuple(sorted(layout.moves, key=lambda move: (move.start, move.axis)))
    told = Program(moves, tuple(layout.begin), layout.now)
    tracks = layout.tracks()
    finely = samples(rig, tracks, told.duration, cycles)
    checks = check(rig, tracks, finely, layout.strange, cycles)
    found = finely.every(round(rig.bus.sync_period / finely.step))
    return Plan(rig, told, tracks, found, cycles, checks, _image_speed(rig, found))


def rest(bus: Bus) -> float:
    """s between two moves of an axis: for the drive's hand-shake, for it to say that it has arrived, and for its mode to change."""
    return max(REST, REST_SYNCS * bus.sync_period)


class _Layout:
    """Puts moves on the grid of the SYNC, in whole quadcounts, rpm and rpm/s, so that what is planned is what is run.

    strange [axes]: how many moves of an axis its drive's modes do not know
    """

    def __init__(self, rig: Rig, steps: Sequence[Step]) -> None:
        self.rig, self.now = rig, 0.0
        first = [next((step[k].begin for step in steps if k in step), axis.homing.offset) for k, axis in enumerate(rig.axes)]
        self.begin = [_counted(axis, x) for axis, x in zip(rig.axes, first, strict=True)]
        self.parts: list[list[Profile]] = [[Dwell(x, 0.0)] for x in self.begin]
        self.rested = [0.0] * len(rig.axes)  # since when each axis does
        self.moves: list[program.Move] = []
        self.strange = [0] * len(rig.axes)

    def approach(self, step: Step) -> None:
        """To where the step begins."""
        way: dict[int, Profile] = {}
        for k, profile in step.items():
            axis, here = self.rig.axes[k], self.parts[k][-1].end
            if abs(profile.begin - here) > abs(quantum(axis)):
                way[k] = profiles.Move(here, profile.begin, APPROACH * axis.limits.v, APPROACH * axis.limits.a)
        self.run(way)

    def run(self, step: Step) -> None:
        """All of it, beginning on one SYNC; the next begins when all of its axes rest."""
        ends = [self.now]
        for k, profile in step.items():
            time, last, free = self.now, 0.0, self.now
            for offset, move in profile.moves:
                time, last = self._ceil(max(time + offset - last, free)), offset
                free = time + self._move(k, time, move) + rest(self.rig.bus)
            ends.append(max(free, time + profile.duration - last))
        self.now = self._ceil(max(ends))

    def tracks(self) -> tuple[Track, ...]:
        ends = [Dwell(parts[-1].end, self.now - rested) for parts, rested in zip(self.parts, self.rested, strict=True)]
        return tuple(profiles.Sequence((*parts, end)) for parts, end in zip(self.parts, ends, strict=True))

    def _move(self, k: int, time: float, wanted: profiles.Move) -> float:
        """One move as the drive runs it -> its duration."""
        axis, parts = self.rig.axes[k], self.parts[k]
        v, a, here = drivable(axis, wanted.v), drivable(axis, wanted.a), parts[-1].end
        if not v or not a:
            what = f"axis {axis.name}: {wanted.v:.3g} /s or {wanted.a:.3g} /s² is less than 1 rpm or 1 rpm/s of the motor"
            raise Refused(f"{what}, which is the least that a drive can be told\n  what to do: move faster")
        self.strange[k] += math.isfinite(wanted.j) or axis.mode not in ("auto", {"position": "ppm", "velocity": "pvm"}[wanted.mode])
        if wanted.mode == "position":
            move = profiles.Move(here, _counted(axis, wanted.end), v, a)
            if not move.duration:
                return 0.0
            self.moves.append(program.Move(time, k, "position", move.end, v, a))
        else:
            stop = self._ceil(max(wanted.duration - rise(wanted.v, wanted.a), rise(v, a)))
            move = cruise(here, wanted.way * v, a, stop - rise(v, a))
            self.moves.append(program.Move(time, k, "velocity", move.end, wanted.way * v, a))
            self.moves.append(program.Move(time + stop, k, "velocity", move.end, 0.0, a))
        parts += [Dwell(here, time - self.rested[k]), move]
        self.rested[k] = time + move.duration
        return move.duration

    def _ceil(self, time: float) -> float:
        """The next SYNC."""
        if not time <= LONGEST:
            raise Refused(f"the profile is longer than {LONGEST:g} s\n  what to do: move faster or rest less; run --repeat repeats it")
        period = self.rig.bus.sync_period
        return math.ceil(time / period - 1e-6) * period


def _counted(axis: Axis, x: float) -> float:
    """To whole quadcounts."""
    if not abs(x) <= COUNTS * abs(quantum(axis)):
        raise Refused(f"axis {axis.name}: {x:.4g} is beyond what its drive can count\n  what to do: stay within its limits")
    return float(from_quadcounts(axis, quadcounts(axis, x))) + 0.0  # -0.0 is 0.0


def _image_speed(rig: Rig, samples: Samples) -> float | None:
    """Of the image's centre, where the scene is `distance` before the camera: x' = -f (vx / Z + wy), y' = -f (vy / Z - wx)."""
    if rig.focal is None or rig.distance is None:
        return None
    v, omega = Chain(rig).twist(samples.x, samples.v)
    return float(rig.focal * np.hypot(v[:, 0] / rig.distance + omega[:, 1], v[:, 1] / rig.distance - omega[:, 0]).max())


def _finite(value: Any) -> Any:
    """For JSON, which knows no infinite numbers."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
