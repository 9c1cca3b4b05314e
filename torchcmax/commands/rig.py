"""torchcmax rig: a motor rig that moves the camera or the scene."""

from __future__ import annotations

import dataclasses
import json
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax.commands import rigtruth
from torchcmax.commands.arguments import folder
from torchcmax.commands.rigtruth import tell
from torchcmax.config import USAGE_ERROR, Parser, UsageError
from torchcmax.io import DataError
from torchcmax.rig.errors import Aborted, Refused, RigError

if TYPE_CHECKING:  # the extra may be missing
    from torchcmax.rig.config import Rig
    from torchcmax.rig.plan import Plan

SUMMARY = "move a motor rig, and make ground truth from its encoders"
EXTRA = ("can", "canopen", "scipy", "matplotlib")
AT_THE_RIG = ("run", "home", "record")
EMERGENCY = "a hardware emergency stop within reach is your duty; nothing that this program does is a safety function"
DESCRIPTION = (
    "Move a motor rig (slider, rotary stage, pan-tilt; maxon EPOS4 and EPOS2 drives on CANopen) and make ground truth from its encoders: "
    "plan, check, home, run, sync, truth. Try it without hardware: run --dry-run. Mind: "
    f"{EMERGENCY}. docs/rig.md leads from a new rig to its first run. Exits 0: done, 2: configuration, plan or a file refused, "
    "3: a drive's fault, or anything unforeseen while a rig is moved, 4: communication lost, 5: stopped by the user, 6: clocks not aligned."
)
ARM_HELP = f"let hardware move: {EMERGENCY}"


def build() -> Parser:
    """Without its actions."""
    return Parser(description=DESCRIPTION)


def add_actions(parser: Parser) -> None:
    """Each a command of its own."""
    commands = parser.add_subcommands(required=True, dest="action")
    for name, (options, _, help) in ACTIONS.items():
        sub = Parser(description=f"{help[0].upper()}{help[1:]}.")
        options(sub)
        commands.add_subcommand(name, sub, help=help)


def run(config: Namespace) -> int:
    """torchcmax rig"""
    try:
        with _terminable():
            ACTIONS[config.action][1](config[config.action])
    except (RigError, DataError) as error:
        tell(f"torchcmax rig {config.action}: {error}", sys.stderr)
        return error.code if isinstance(error, RigError) else USAGE_ERROR
    except KeyboardInterrupt:
        tell(f"\ntorchcmax rig {config.action}: stopped by the user", sys.stderr)
        return Aborted.code
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name in EXTRA:
            raise UsageError(f"{error.name} is not installed; what to do: pip install 'torchcmax[rig]'") from error
        if isinstance(error, UsageError) or config.action not in AT_THE_RIG:
            raise
        tell(traceback.format_exc(), sys.stderr)
        return RigError.code
    return 0


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM is Ctrl-C; while drives are on, the runner takes both."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _rig_options(sub: Parser) -> None:
    sub.add_argument("rig", type=str, help="YAML file of the rig, like configs/rig/slider.yaml")


def _profile_options(sub: Parser) -> None:
    _rig_options(sub)
    sub.add_argument("profile", type=str, help="YAML file of the motion, like configs/rig/slider_pass.yaml")
    sub.add_argument("--repeat", type=int, default=1, help="how many times")


def _bus_options(sub: Parser) -> None:
    sub.add_argument("--dry-run", action="store_true", help="simulated drives and motors, on a bus within this process")
    sub.add_argument("--interface", type=str, default="", help="of python-can, like socketcan, instead of what the rig's file says")
    sub.add_argument("--channel", type=str, default="", help="like can0, instead of what the rig's file says")


def _moving_options(sub: Parser) -> None:
    _bus_options(sub)
    sub.add_argument("--arm", action="store_true", help=ARM_HELP)
    sub.add_argument("--reset-fault", action="store_true", help="reset a drive that is in its fault state, once; it stays switched off")
    sub.add_argument("--quiet", action="store_true", help="no progress bar")


def _motors_options(sub: Parser) -> None:
    sub.add_argument("--verify", action="store_true", help="check the identities between the printed numbers")


def _plan_options(sub: Parser) -> None:
    _profile_options(sub)
    sub.add_argument("-o", "--out", type=str, default="", help="folder for plan.json and pictures; default: only print")


def _run_options(sub: Parser) -> None:
    _profile_options(sub)
    _moving_options(sub)
    sub.add_argument("-o", "--out", type=str, required=True, help="folder to write")


def _home_options(sub: Parser) -> None:
    _rig_options(sub)
    _moving_options(sub)
    sub.add_argument("-o", "--out", type=str, default="home", help="folder for the log")


def _check_options(sub: Parser) -> None:
    _rig_options(sub)
    _bus_options(sub)


def _record_options(sub: Parser) -> None:
    _check_options(sub)
    sub.add_argument("--duration", type=float, default=60.0, help="s")
    sub.add_argument("--quiet", action="store_true", help="no progress bar")
    sub.add_argument("-o", "--out", type=str, required=True, help="folder to write")


def _motors(config: Namespace) -> None:
    from torchcmax.rig.motors import UNITS, motors, verify

    shown = "voltage no_load_speed nominal_speed nominal_torque nominal_current resistance torque_constant max_speed".split()
    heads = [UNITS[name][0] for name in shown]
    tell("  ".join(["part  ", *heads, "motor"]))
    for motor in motors().values():
        numbers = [f"{getattr(motor, name) / UNITS[name][1]:>{len(head)}.4g}" for name, head in zip(shown, heads, strict=True)]
        tell("  ".join([motor.part, *numbers, motor.family]))
    for motor in motors().values() if config.verify else ():
        for found in verify(motor):
            column, unit = UNITS[found.field]
            verdict = "OUTSIDE OF ROUNDING" if found.outside_rounding else "within rounding"
            numbers = [f"printed {found.printed / unit:.4g}, computed {found.computed / unit:.4g}, {100 * found.relative:+.2f} %"]
            tell(f"{motor.part}  {column} = {found.identity}: {numbers[0]}, {verdict}")


def _plan(config: Namespace) -> None:
    out = folder(config.out) if config.out else None
    if out is not None and (out / "encoder.csv").exists():
        raise UsageError(f"{out} holds a run: give another folder for the plan")
    plan = _planned(config)
    tell(_table(plan))
    if out is not None:
        _begin(out, config)
        _draw(out, plan)
    plan.refuse()


def _run(config: Namespace) -> None:
    out = folder(config.out)
    _armed(config)
    from torchcmax.rig.runner import run

    plan = _planned(config)
    plan.refuse()
    _begin(out, config)
    with rigtruth.kept(out, plan.rig, config.dry_run, plan.samples):
        _draw(out, plan)
        with _watched(config, plan.program.duration * config.repeat, plan.rig) as watch:
            told = {"simulate": config.dry_run, "arm": config.arm, "repeat": config.repeat, "reset": config.reset_fault}
            run(plan.rig, plan.program, out, watch=watch, **told)
    tell(f"run: {out}, {'simulated' if config.dry_run else plan.rig.name}; the clock is next: torchcmax rig sync {out} --help")


def _home(config: Namespace) -> None:
    from torchcmax.rig.runner import home

    _armed(config)
    rig, out = _rig(config), folder(config.out)
    _begin(out, config)
    with _watched(config, 0.0, rig) as watch:
        home(rig, out, simulate=config.dry_run, arm=config.arm, reset=config.reset_fault, watch=watch)
    tell(f"home is known; log: {out / 'log.jsonl'}")


def _check(config: Namespace) -> None:
    from torchcmax.rig.runner import check

    tell(json.dumps(check(_rig(config), simulate=config.dry_run), indent=2))


def _record(config: Namespace) -> None:
    from torchcmax.rig.runner import watch_encoders

    if not 0 < config.duration < 86_400:
        raise UsageError(f"--duration wants seconds above 0, got {config.duration}")
    rig, out = _rig(config), folder(config.out)
    _begin(out, config)
    with rigtruth.kept(out, rig, config.dry_run), _watched(config, config.duration, rig) as watch:
        watch_encoders(rig, out, config.duration, simulate=config.dry_run, watch=watch)
    tell(f"record: {out / 'encoder.csv'}")


def _armed(config: Namespace) -> None:
    """Nothing of an older run goes away for one that may not begin."""
    if not (config.dry_run or config.arm):
        raise Refused(f"this would move hardware, and is not armed\n  what to do: try --dry-run, or give --arm; {EMERGENCY}")


def _rig(config: Namespace) -> Rig:
    """As its file has it, and the options that stand above it."""
    from torchcmax.rig.config import load

    rig = load(config.rig)
    other = {name: config[name] for name in ("interface", "channel") if config.get(name)}
    return dataclasses.replace(rig, bus=dataclasses.replace(rig.bus, **other))


def _planned(config: Namespace) -> Plan:
    from torchcmax.rig.plan import plan
    from torchcmax.rig.profilefile import load_profile

    if not 1 <= config.repeat <= 10_000:
        raise UsageError(f"--repeat wants a number from 1 to 10000, got {config.repeat}")
    rig = _rig(config)
    return plan(rig, load_profile(config.profile, rig), config.repeat)


def _table(plan: Plan) -> str:
    """Every check in a line."""
    lines = [f"{'':8} {'check':40} {'worst':>10} {'limit':>10} {'':8} {'margin':>10} {'at s':>8}"]
    for check in plan.checks:
        numbers = f"{check.value:10.4g} {check.limit:10.4g} {check.unit:8} {check.margin:10.4g} {check.time:8.3f}"
        lines.append(f"{check.axis or 'rig':8} {check.name:40} {numbers}  {'' if check.ok else 'NOT KEPT'}".rstrip())
    lines.append(
        f"{len(plan.program.moves)} moves in {plan.program.duration:.3f} s; {'once' if plan.cycles == 1 else f'{plan.cycles} times'}"
    )
    if plan.image_speed is not None:
        lines.append(f"the image moves at up to {plan.image_speed:.0f} px/s")
    return "\n".join(lines)


def _begin(out: Path, config: Namespace) -> None:
    """A folder with the files that the command was given, and without what an older run left there."""
    from torchcmax.rig.record import write_whole

    given = {rigtruth.LOCK: config.rig, "profile.yaml": config.get("profile")}
    try:
        contents = {name: Path(file).read_bytes() for name, file in given.items() if file}  # which may lie in this very folder
        out.mkdir(parents=True, exist_ok=True)
        rigtruth.clear(out, rigtruth.OF_RUNS)  # what does not begin leaves nothing that could be taken for its own
        for name, content in contents.items():
            write_whole(out / name, content)
    except OSError as error:
        raise UsageError(f"{error.filename}: {error.strerror}; what to do: give another folder with -o") from error


def _draw(out: Path, plan: Plan) -> None:
    """plan.json, and pictures of it."""
    from torchcmax.rig import picture
    from torchcmax.rig.record import write_whole

    write_whole(out / "plan.json", json.dumps(plan.summary(), indent=2) + "\n")
    write_whole(out / "motion.png", picture.motion(plan.rig, plan.samples, None))
    for k, axis in enumerate(plan.rig.axes):
        write_whole(out / f"oprange_{axis.name}.png", picture.operating_range(plan.rig, k, plan.samples))


class _Screen:
    """sys.stderr for a bar that must not stop a rig."""

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)

    def write(self, text: str) -> None:
        tell(text, sys.stderr, "")

    def flush(self) -> None:
        """Each write is."""


@contextmanager
def _watched(config: Namespace, seconds: float, rig: Rig) -> Iterator[Callable[[int], None]]:
    """A progress bar in seconds of the drives' clock, which is told the SYNCs; and what nobody may forget."""
    if config.get("arm") and not config.dry_run:
        tell(f"mind: {EMERGENCY}", sys.stderr)
    layout = "{l_bar}{bar}| {n:.1f}/{total:.1f} s [{elapsed}]"
    with tqdm(total=seconds, desc=rig.name, disable=config.quiet, bar_format=layout, file=_Screen()) as bar:

        def watch(k: int) -> None:
            if k % 100 == 0:
                done = k * rig.bus.sync_period
                bar.total = max(seconds, done)  # homing, and the way to where it begins, come before
                bar.update(done - bar.n)

        yield watch


ACTIONS: dict[str, tuple[Callable[[Parser], None], Callable[[Namespace], None], str]] = {
    "motors": (_motors_options, _motors, "show the motors whose data sheets are known, and how far these agree with themselves"),
    "plan": (_plan_options, _plan, "check a motion against every limit, and say what motors and supply need for it; no hardware"),
    "run": (_run_options, _run, "run a planned motion and record the encoders"),
    "home": (_home_options, _home, "find home on every axis"),
    "check": (_check_options, _check, "say who is on the bus and how it is set up; writes nothing to the drives"),
    "record": (_record_options, _record, "record the encoders of a rig that is moved by hand, its drives switched off"),
    "sync": (rigtruth.sync_options, rigtruth.sync, "find the camera's clock, by the velocity that it saw or the rate of its events"),
    "truth": (rigtruth.truth_options, rigtruth.truth, "write ground truth in the camera's clock"),
}
