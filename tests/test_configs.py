"""Every configuration that we hand out can be used, and the defaults written there are the defaults."""

from pathlib import Path

import pytest
import yaml

from torchcmax.cli import build, main

CONFIGS = Path(__file__).parents[1] / "configs"
DEFAULTS = {"default.yaml": "track", "default_panorama.yaml": "panorama", "default_compensate.yaml": "compensate"}
OTHERS = {
    "demo_simulate.yaml": "simulate", "demo_track.yaml": "track", "sharp.yaml": "compensate", "thesis.yaml": "track",
    "thesis_window.yaml": "compensate", "uncalibrated.yaml": "track",
}  # fmt: skip


def test_every_configuration_is_known_here():
    assert {path.name for path in CONFIGS.iterdir() if path.is_file()} == {*DEFAULTS, *OTHERS}


@pytest.mark.parametrize("name", DEFAULTS)
def test_the_defaults_that_are_written_down_are_the_defaults(name, capsys):
    with pytest.raises(SystemExit):
        main([DEFAULTS[name], "--print_config"])
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed == yaml.safe_load((CONFIGS / name).read_text())
    assert len(printed) > 5


@pytest.mark.parametrize("name", [*DEFAULTS, *OTHERS])
def test_a_configuration_has_no_unknown_option(name):
    command = {**DEFAULTS, **OTHERS}[name]
    named = ["--out", "o"] if command == "simulate" else ["recording", "--out", "o"]
    config = build().parsed([command, *named, "--config", str(CONFIGS / name)])[command]
    for key, value in yaml.safe_load((CONFIGS / name).read_text()).items():
        if not isinstance(value, dict | list):
            assert config[key] == value, key
