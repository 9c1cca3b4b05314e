"""Files of motions: steps, one after the other, each of one axis or of some that begin on one SYNC.

    profile:
      - {axis: x, sync: {}}                                        # the pattern that clocks are aligned by
      - {axis: x, pass: {x0_m: 0.12, x1_m: 0.55, v_mps: 1.0}}      # constant speed from x0 to x1
      - {axis: x, dwell_s: 0.5}
      - {axis: x, return: {v_mps: 0.2}}                            # to where the axis began
      - {axis: pan, cruise: {v_degps: 90, hold_s: 2}}              # profile velocity mode
      - together: [{axis: pan, move: {to_deg: 30, v_degps: 90}}, {axis: tilt, move: {to_deg: 10, v_degps: 30}}]
      - repeat: {times: 3, steps: [...]}

Units are those of the axis, as in the rig's file.  Motions take a_mps2 too, else the axis' limit, sync half of it; pass and move take
j_mps3, which no drive's profile mode runs.  An axis whose first step says no other place begins at its home; one that stands elsewhere than
its next step begins goes there first, with a quarter of its limits.  A profile lasts an hour at most.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from torchcmax.rig.config import UNITS, Rig, Unit
from torchcmax.rig.errors import Refused
from torchcmax.rig.plan import LONGEST, Step, rest
from torchcmax.rig.profiles import Dwell, Move, Profile, constant_pass, cruise, sync
from torchcmax.rig.section import LARGEST, Section, read

KINDS = ("move", "pass", "return", "cruise", "sync", "dwell_s")
MOST = 10000  # steps, repeated ones counted


def load_profile(path: str | Path, rig: Rig) -> tuple[Step, ...]:
    """The steps of a YAML file for a rig; Refused with the line, what is wrong and what to do."""
    top, _ = read(Path(path), "profile")
    reader = _Reader(rig, top.file)
    try:
        reader.steps(top.items("profile"))
    except RecursionError as error:
        raise Refused(f"{top.file}: has steps that hold themselves\n  what to do: write them out, without & and *") from error
    return tuple(reader.found)


@dataclass
class _Reader:
    """Follows where every axis stands, by its index, and where it began."""

    rig: Rig
    file: Path
    found: list[Step] = field(default_factory=list)
    place: dict[int, float] = field(default_factory=dict)
    began: dict[int, float] = field(default_factory=dict)

    def steps(self, nodes: Sequence[yaml.Node]) -> None:
        for node in nodes:
            step = Section(self.file, "step", node, "", f"axis together repeat {' '.join(KINDS)}")
            if len(self.found) >= MOST:
                raise step.refused(f"these are more than {MOST} steps", "repeat less often")
            if "repeat" in step:
                again = Section(self.file, "step", node, "repeat").section("repeat", "times steps")
                for _ in range(again.whole("times", 1, MOST)):
                    self.steps(again.items("steps"))
            elif "together" in step:
                parts = [self._part(part) for part in Section(self.file, "step", node, "together").items("together")]
                if len({axis for axis, _ in parts}) < len(parts):
                    raise step.wrong("together", "wants every axis once", "give each axis one motion")
                self._add(dict(parts))
            else:
                self._add(dict([self._part(node)]))

    def _add(self, step: Step) -> None:
        for axis, profile in step.items():
            self.began.setdefault(axis, profile.begin)
            self.place[axis] = profile.end
        self.found.append(step)

    def _part(self, node: yaml.Node) -> tuple[int, Profile]:
        """One axis' motion."""
        step = Section(self.file, "step", node, "axis", " ".join(KINDS))
        names = [axis.name for axis in self.rig.axes]
        axis = names.index(step.choice("axis", *names))
        kinds = [kind for kind in KINDS if kind in step]
        if len(kinds) != 1:
            raise step.refused(f"a step has one motion, this has {len(kinds)}", f"give one of {', '.join(KINDS)}")
        return axis, self._profile(step, kinds[0], axis)

    def _profile(self, step: Section, kind: str, axis: int) -> Profile:
        limits, unit = self.rig.axes[axis].limits, UNITS[self.rig.axes[axis].kind]
        here = self.place.get(axis, self.rig.axes[axis].homing.offset)
        if kind == "dwell_s":
            return Dwell(here, step.number("dwell_s", least=0, most=LONGEST))
        v, a, j = f"v_{unit.rate}", f"a_{unit.rate}2", f"j_{unit.rate}3"
        if kind == "sync":
            given = step.section(kind, "", f"from_{unit.place} to_{unit.place} {v} {a}")
            return self._sync(given, axis, _or(given, v, limits.v / 2, unit), _or(given, a, limits.a / 2, unit))
        wanted, optional = {
            "move": (f"to_{unit.place} {v}", f"{a} {j}"),
            "pass": (f"x0_{unit.place} x1_{unit.place} {v}", f"{a} {j} settle_s"),
            "return": (v, a),
            "cruise": (f"{v} hold_s", a),
        }[kind]
        given = step.section(kind, wanted, optional)
        speed = given.number(v, above=-LARGEST if kind == "cruise" else 0.0) * unit.scale
        acceleration, jerk = _or(given, a, limits.a, unit), _or(given, j, math.inf, unit) if j in given else math.inf
        if kind == "return":
            return Move(here, self.began.get(axis, here), speed, acceleration)
        if kind == "move":
            return Move(here, given.number(f"to_{unit.place}") * unit.scale, speed, acceleration, jerk)
        if kind == "cruise":
            if not speed:
                raise given.wrong(v, "is 0", "give the velocity, with its sign, or dwell_s to rest")
            return cruise(here, speed, acceleration, given.number("hold_s", least=0, most=LONGEST))
        x0, x1 = (given.number(f"{end}_{unit.place}") * unit.scale for end in ("x0", "x1"))
        if x0 == x1:
            raise given.refused("the pass begins where it ends", "give two places")
        settle = given.number("settle_s", least=0, most=LONGEST) if "settle_s" in given else 0.05
        return constant_pass(x0, x1, speed, acceleration, jerk, settle)

    def _sync(self, given: Section, axis: int, v: float, a: float) -> Profile:
        """Where no place is given, in the middle of the axis, as far as it takes to reach the speed."""
        limits, unit = self.rig.axes[axis].limits, UNITS[self.rig.axes[axis].kind]
        length, middle = min(v**2 / a, (limits.max - limits.min) / 4), (limits.min + limits.max) / 2
        near, far = (f"{word}_{unit.place}" for word in ("from", "to"))
        begin, end = _or(given, near, middle - length / 2, unit, False), _or(given, far, middle + length / 2, unit, False)
        if begin == end:
            raise given.refused("the pattern begins where it ends", "give two places")
        return sync(begin, end, v, a, rest(self.rig.bus))


def _or(given: Section, key: str, otherwise: float, unit: Unit, positive: bool = True) -> float:
    """A number of the axis' unit, where it is given."""
    return given.number(key, above=0.0 if positive else -LARGEST) * unit.scale if key in given else otherwise
