import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "reproduce_thesis.py"


@pytest.mark.slow
def test_a_wrong_motion_and_plane_have_at_least_the_contrast_of_the_truth_and_a_turning_camera_sees_a_panorama(tmp_path):
    done = subprocess.run([sys.executable, SCRIPT, "--out", tmp_path], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "figure_2_3.json").read_text())
    assert found["wrong"]["contrast"] >= found["truth"]["contrast"]
    assert found["angle_between_the_normals_deg"] > 20
    assert (tmp_path / "figure_2_3.png").stat().st_size > 10_000
    found = json.loads((tmp_path / "figure_2_6.json").read_text())
    assert found["lost"] == 0
    assert found["orientation_rmse_deg"] < 0.25
    assert (tmp_path / "figure_2_6.png").stat().st_size > 10_000
