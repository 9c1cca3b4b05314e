"""The command line: torchcmax COMMAND.  Exits 0 when all went well, 1 on bad data, 2 on wrong usage."""

from __future__ import annotations

import os
import sys
import warnings
from typing import Any

import torch

from torchcmax import __version__
from torchcmax.commands import batch, compensate, convert, evaluate, info, panorama, report, rig, simulate, track
from torchcmax.config import USAGE_ERROR, Parser, UsageError, parser
from torchcmax.io import DataError, DataNote, DataWarning

COMMANDS = {
    "simulate": simulate, "info": info, "convert": convert, "compensate": compensate, "track": track, "panorama": panorama, "batch": batch,
    "evaluate": evaluate, "report": report, "rig": rig,
}  # fmt: skip
KEEPING = ("compensate", "track", "panorama", "batch")  # commands that leave what was finished when they are stopped
DATA_ERROR, INTERRUPTED = 1, 130
DESCRIPTION = """Motion from event cameras by contrast maximization: warp the events of a window with a candidate motion, vote them
into an image; the right motion is the one that makes the image sharpest."""


def build() -> Parser:
    """The whole command line."""
    main = parser("torchcmax", DESCRIPTION)
    main.add_argument("--version", action="version", version=__version__)
    commands = main.add_subcommands(required=True, dest="command")
    parsers = {name: module.build() for name, module in COMMANDS.items()}
    for name, module in COMMANDS.items():
        commands.add_subcommand(name, parsers[name], help=module.SUMMARY)
    rig.add_actions(parsers["rig"])  # inner commands come after all outer ones
    return main


def main(arguments: list[str] | None = None) -> int:
    """Run one command; the exit status is returned."""
    torch.set_num_threads(1)  # what is left to torch is too little work for two: they would spin
    warnings.showwarning = _say
    config = build().parsed(arguments)
    name = config.command
    try:
        status: int = COMMANDS[name].run(config[name])
        return status
    except UsageError as error:
        print(f"torchcmax {name}: {error}", file=sys.stderr)
        return USAGE_ERROR
    except DataError as error:
        print(f"torchcmax {name}: {error}", file=sys.stderr)
        return DATA_ERROR
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        kept = "; what was finished is kept" if name in KEEPING else ""
        print(f"\ntorchcmax {name}: stopped{kept}", file=sys.stderr)
        return INTERRUPTED


def _say(message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: str | None = None) -> None:
    if issubclass(category, (DataWarning, DataNote)):  # others are for developers
        print(f"{'note' if issubclass(category, DataNote) else 'warning'}: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
