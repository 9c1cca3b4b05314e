"""torchcmax info: what is in a recording."""

from __future__ import annotations

import dataclasses
import json

from jsonargparse import Namespace

from torchcmax.commands.arguments import add_opening, opening
from torchcmax.config import Parser, command
from torchcmax.io import open, summary

SUMMARY = "say what is in a recording, and what is wrong with it"


def build() -> Parser:
    """Its options."""
    sub = command("Say what is in a recording: sensor, calibration, duration, counts, rate over time, gaps, problems found.")
    sub.add_argument("--json", action="store_true", help="print JSON instead of text")
    add_opening(sub)
    return sub


def run(config: Namespace) -> int:
    """torchcmax info"""
    found = summary(open(config.recording, opening(config)))
    print(json.dumps(dataclasses.asdict(found), indent=1) if config.json else found)
    return 0
