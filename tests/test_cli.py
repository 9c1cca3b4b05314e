"""The command line as a user meets it: exit status, messages, files."""

import csv
import json
import subprocess
import sys

import pytest
import yaml

from torchcmax.cli import main
from torchcmax.config import USAGE_ERROR


def run(capsys, *arguments):
    """Exit status, what was printed, what was complained about."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:
        status = stop.code
    out, err = capsys.readouterr()
    return status, out, err


def test_compensate_writes_all_that_it_promises(demo, tmp_path, capsys):
    status, out, _ = run(capsys, "compensate", demo, "--model", "planar", "--events", 5000, "--out", tmp_path / "run", "--images", 1)
    assert status == 0
    folder = tmp_path / "run"
    lines = list(csv.DictReader((folder / "windows.csv").open()))
    summary = json.loads((folder / "summary.json").read_text())
    assert len(lines) == summary["windows"] == len(list((folder / "images").glob("*.png"))) > 5
    assert list(folder.glob("events.out.tfevents.*"))
    assert str(folder / "images") in out
    assert "tensorboard --logdir" in out


def test_the_configuration_of_a_run_makes_the_same_run_again(demo, tmp_path, capsys):
    first = ("--model", "translation", "--events", 9000, "--limit", 2, "--look.contrast", "gradient_magnitude", "--search.blur", "[2,1]")
    assert run(capsys, "compensate", demo, *first, "--out", tmp_path / "a", "--quiet")[0] == 0
    config = json.loads((tmp_path / "a" / "summary.json").read_text())["config"]
    settings = yaml.safe_load(config)
    (tmp_path / "again.yaml").write_text(yaml.safe_dump(settings))
    assert run(capsys, "compensate", demo, "--config", tmp_path / "again.yaml", "--out", tmp_path / "b", "--quiet")[0] == 0
    assert (tmp_path / "a" / "windows.csv").read_text() == (tmp_path / "b" / "windows.csv").read_text()


def test_options_behind_a_config_override_it(demo, tmp_path, capsys):
    (tmp_path / "c.yaml").write_text("events: 5000\nmodel: planar\nlook:\n  contrast: mean_square\n")
    arguments = ("--config", tmp_path / "c.yaml", "--events", 7000, "--limit", 1, "--quiet")
    assert run(capsys, "compensate", demo, *arguments, "--out", tmp_path / "r")[0] == 0
    settings = yaml.safe_load(json.loads((tmp_path / "r" / "summary.json").read_text())["config"])
    assert (settings["events"], settings["model"], settings["look"]["contrast"]) == (7000, "planar", "mean_square")


def test_info_says_what_is_there(demo, capsys):
    status, out, _ = run(capsys, "info", demo)
    assert status == 0
    for word in ("240 x 180", "fx 200", "plumb_bob", "events", "Mev/s", "gaps", "poses"):
        assert word in out
    status, out, _ = run(capsys, "info", demo, "--json")
    found = json.loads(out)
    assert found["sensor"] == [240, 180]
    assert found["count"] > 1000
    assert found["rates"]


def test_simulate_writes_a_recording_that_info_can_read(tmp_path, capsys):
    arguments = ("--scene", "shapes", "--motion", "rotation", "--duration", 0.05, "--width", 120, "--height", 90, "--focal", 100)
    assert run(capsys, "simulate", "--out", tmp_path / "rec", *arguments)[0] == 0
    status, out, _ = run(capsys, "info", tmp_path / "rec")
    assert status == 0
    assert "120 x 90" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("compensate", "R", "--out", "O", "--evnts", "3"), "did you mean --events?"),
        (("compensate", "R", "--out", "O", "--event", "3"), "did you mean --events?"),
        (("compensate", "R", "--out", "O", "--look.contrst", "variance"), "did you mean --look.contrast?"),
        (("compensate", "R", "--out", "O", "--model", "rotatoin"), "did you mean rotation?"),
        (("compensat", "R"), "did you mean compensate?"),
        (("compensate", "R", "--out", "O", "--events", "many"), "events"),
        (("compensate", "R"), "out"),
        (("compensate", "R", "--out", "O", "--events", "0"), "events wants a number of at least 2"),
        (("compensate", "R", "--out", "O", "--sensor", "240"), "--sensor wants width x height"),
        (("compensate", "R", "--out", "O", "--device", "warp9"), "--device wants cpu"),
        (("compensate", "R", "--out", "O", "--look.contrast", "sharp"), "contrast"),
        (("compensate", "R", "--out", "O", "--device", "meta"), "--device wants cpu"),
        (("compensate", "R", "--out", "O", "--device", "cuda:77"), "CUDA devices"),
        (("compensate", "R", "--out", "O", "--search.blur", "[]"), "a search wants"),
        (("compensate", "R", "--out", "O", "--search.margin", "-5"), "a search wants"),
        (("compensate", "R", "--out", "O", "--look.guard", "-1"), "a look wants"),
        (("compensate", "R", "--out", "O", "--search.stop.longest", "0"), "stop wants"),
        (("compensate", "R", "--out", "O", "--images", "-1"), "--images wants"),
        (("compensate", "R", "--out", "O", "--plane", "truth"), "--plane goes with --model planar"),
        (("compensate", "R", "--out", ""), "--out wants the name of a folder"),
        (("compensate", "", "--out", "O"), "the recording's name is empty"),
        (("simulate", "--out", "O", "--scene", "postr"), "poster"),
        ((), "command"),
    ],
)
def test_wrong_usage_exits_with_2_and_names_the_nearest(arguments, words, demo, tmp_path, capsys):
    filled = [str(demo) if a == "R" else str(tmp_path / "o") if a == "O" else a for a in arguments]
    status, _, err = run(capsys, *filled)
    assert status == USAGE_ERROR == 2
    assert words in err
    assert not (tmp_path / "o").exists()


def test_a_typo_in_a_config_file_is_named(demo, tmp_path, capsys):
    (tmp_path / "c.yaml").write_text("look:\n  contrst: variance\n")
    status, _, err = run(capsys, "compensate", demo, "--config", tmp_path / "c.yaml", "--out", tmp_path / "o")
    assert status == 2
    assert "did you mean look.contrast?" in err


@pytest.mark.parametrize("text", ["look: 3\n", "just words\n", "- a\n- list\n", "events: [1, 2]\n", b"\xff\xfe\x00bad"])
def test_a_config_of_another_form_is_wrong_usage_and_no_traceback(text, demo, tmp_path, capsys):
    (tmp_path / "c.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    status, _, err = run(capsys, "compensate", demo, "--config", tmp_path / "c.yaml", "--out", tmp_path / "o")
    assert status == 2
    assert err.strip()


def test_a_config_does_not_take_the_place_of_the_recording(demo, tmp_path, capsys):
    (tmp_path / "c.yaml").write_text("recording: elsewhere\nevents: 5000\n")
    status, _, err = run(capsys, "compensate", demo, "--config", tmp_path / "c.yaml", "--out", tmp_path / "o")
    assert status == 2
    assert "recording belong" in err
    _, out, _ = run(capsys, "compensate", demo, "--out", tmp_path / "o", "--print_config")
    assert not {"recording", "out"} & set(yaml.safe_load(out))


def test_the_output_is_not_mixed_with_the_recording(tmp_path, capsys):
    lines = "".join(f"{0.001 * i:.6f} {i % 200} {i % 100} {i % 2}\n" for i in range(300))
    (tmp_path / "events.txt").write_text(lines)
    (tmp_path / "calib.txt").write_text("200 200 120 90 0 0 0 0 0\n")
    for out in (tmp_path, tmp_path / "images"):
        status, _, err = run(capsys, "compensate", tmp_path, "--sensor", "240x180", "--events", 300, "--out", out)
        assert status == 1
        assert "is where the recording is" in err


def test_a_run_that_fails_before_its_first_window_leaves_the_earlier_results(demo, tmp_path, capsys):
    arguments = ("compensate", demo, "--out", tmp_path / "o", "--quiet", "--events")
    assert run(capsys, *arguments, 9000)[0] == 0
    before = {p: p.read_bytes() for p in (tmp_path / "o").rglob("*") if p.is_file()}
    assert run(capsys, *arguments, 99_999_999)[0] == 1
    assert {p: p.read_bytes() for p in (tmp_path / "o").rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("name", ["windows.csv", "summary.json", "images/window_00007.png"])
def test_what_another_program_wrote_is_not_replaced(name, demo, tmp_path, capsys):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("{}")
    (tmp_path / "events.out.tfevents.1").write_text("theirs")
    status, _, err = run(capsys, "compensate", demo, "--out", tmp_path, "--events", 9000)
    assert status == 1
    assert "no run of ours wrote" in err
    assert (tmp_path / name).read_text() == "{}"
    assert (tmp_path / "events.out.tfevents.1").read_text() == "theirs"


@pytest.mark.parametrize("start", [59_123_457, 1_700_000_000_000_001])
def test_times_are_exact_to_the_microsecond_however_late(start, tmp_path, capsys):
    stamps = [start + 7 * i for i in range(3000)]
    lines = (f"{t // 10**6}.{t % 10**6:06d} {37 * i % 240} {53 * i % 180} {i % 2}\n" for i, t in enumerate(stamps))
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "events.txt").write_text("".join(lines))
    (tmp_path / "rec" / "calib.txt").write_text("200 200 120 90 0 0 0 0 0\n")
    assert run(capsys, "compensate", tmp_path / "rec", "--sensor", "240x180", "--events", 1000, "--out", tmp_path / "o")[0] == 0
    lines = list(csv.DictReader((tmp_path / "o" / "windows.csv").open()))
    assert [(int(line["start_us"]), int(line["end_us"])) for line in lines] == [(stamps[i], stamps[i + 999]) for i in (0, 1000, 2000)]


@pytest.mark.parametrize("command", ["info", "compensate"])
def test_bad_data_exits_with_1_and_says_what_to_do(command, tmp_path, capsys):
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "events.txt").write_text("0.1 1 2 1\n0.2 x 3 0\n")
    (tmp_path / "rec" / "calib.txt").write_text("200 200 120 90 0 0 0 0 0\n")
    out = ("--out", tmp_path / "o") if command == "compensate" else ()
    status, _, err = run(capsys, command, tmp_path / "rec", *out, "--sensor", "240x180")
    assert status == 1
    for word in ("events.txt", "line 2", "'x'", "what to do"):
        assert word in err


def test_a_missing_recording_exits_with_1(tmp_path, capsys):
    status, _, err = run(capsys, "compensate", tmp_path / "nowhere", "--out", tmp_path / "o")
    assert status == 1
    assert "there is no such file or folder" in err
    assert not (tmp_path / "o").exists()


@pytest.mark.filterwarnings("always::torchcmax.io.errors.DataWarning")
def test_strict_refuses_what_is_otherwise_sorted_with_a_warning(tmp_path, capsys):
    lines = [f"{0.001 * i:.6f} {i % 200} {i % 100} {i % 2}\n" for i in range(300)]
    lines[100], lines[101] = lines[101], lines[100]
    (tmp_path / "events.txt").write_text("".join(lines))
    (tmp_path / "calib.txt").write_text("200 200 120 90 0 0 0 0 0\n")
    arguments = ("compensate", tmp_path, "--sensor", "240x180", "--events", 300, "--quiet")
    status, _, err = run(capsys, *arguments, "--out", tmp_path / "a")
    assert status == 0
    assert "warning:" in err
    status, _, err = run(capsys, *arguments, "--out", tmp_path / "b", "--strict")
    assert status == 1
    assert "line 102" in err


def test_help_teaches_every_option(capsys):
    status, out, _ = run(capsys, "compensate", "--help")
    assert status == 0
    for word in ("--model", "--look.contrast", "--search.blur", "--device", "--batch", "--limit", "px", "rad/s"):
        assert word in out


def test_version(capsys):
    status, out, _ = run(capsys, "--version")
    assert status == 0
    assert out.strip() == "0.1.0"


def test_an_interrupted_run_keeps_what_is_done(demo, tmp_path, capsys, monkeypatch):
    import torchcmax.commands.compensate as command

    real = command.compensate

    def interrupted(*arguments):
        parts = real(*arguments)
        yield next(parts)
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "compensate", interrupted)
    status, _, err = run(capsys, "compensate", demo, "--events", 5000, "--batch", 2, "--out", tmp_path / "o")
    assert status == 130
    assert "what was finished is kept" in err
    assert len((tmp_path / "o" / "windows.csv").read_text().splitlines()) == 3
    assert json.loads((tmp_path / "o" / "summary.json").read_text())["complete"] is False


def test_the_installed_command_starts():
    done = subprocess.run([sys.executable, "-m", "torchcmax.cli", "--help"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0
    assert "compensate" in done.stdout
