"""The pages in a real browser, without network."""

import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image
from test_page import batch, result

from torchcmax.batchpage import write_batch_page
from torchcmax.page import write_page

BROWSER = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium here: apt-get install chromium")


def browse(page, folder, *what):
    """Standard output and error of the browser at a page."""
    alone = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder / 'profile'}"]
    quiet = ["--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", "--window-size=1200,2600"]
    done = subprocess.run([BROWSER, *alone, *quiet, *what, page.as_uri()], capture_output=True, text=True, timeout=120, check=True)
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert complaints == []
    return done.stdout


def acted(page, script):
    """The page with a script at its end, which does what a hand would do."""
    text = page.read_text()
    other = page.with_name("acted.html")
    other.write_text(text.replace("</body>", f"<script>{script}</script></body>"))
    return other


def test_a_page_is_drawn_with_its_headings_charts_and_pictures(tmp_path):
    page = write_page(result(tmp_path / "a"))
    dom = browse(page, tmp_path, "--dump-dom")
    for heading in ("Summary", "Trajectory", "Errors over time", "Map", "How it was made"):
        assert f"<h2>{heading}</h2>" in dom
    browse(page, tmp_path, f"--screenshot={tmp_path / 'page.png'}")
    with Image.open(tmp_path / "page.png") as image:
        shot = np.asarray(image.convert("RGB")).astype(int)
    assert shot.shape[1] == 1200
    paper = shot[5, 5]
    assert (np.abs(shot - paper).sum(-1) > 60).mean() > 0.01  # not blank
    blue, orange = (np.abs(shot - colour).sum(-1) < 12 for colour in ((0, 114, 178), (213, 94, 0)))
    assert blue.sum() > 300  # the curves
    assert orange.sum() > 300


def test_pictures_load_and_nothing_else_is_asked_for(tmp_path):
    page = write_page(result(tmp_path / "a"))
    script = """addEventListener('load', async () => { const all = [...document.images]; for (const i of all) i.loading = 'eager';
      await Promise.all(all.map(i => i.decode())); document.title = `${all.filter(i => i.naturalWidth > 0).length} of ${all.length}, ` +
      performance.getEntriesByType('resource').filter(r => !r.name.startsWith('data:')).length + ' fetched' })"""
    assert "<title>7 of 7, 0 fetched</title>" in browse(acted(page, script), tmp_path, "--dump-dom", "--virtual-time-budget=5000")


def test_a_hand_over_a_chart_reads_its_numbers(tmp_path):
    page = write_page(result(tmp_path / "a"))
    script = """const s = document.querySelector('svg.time'), b = s.getBoundingClientRect();
      s.dispatchEvent(new PointerEvent('pointermove', {clientX: b.left + b.width * 0.526}));
      document.title = s.querySelector('.read').textContent"""
    dom = browse(acted(page, script), tmp_path, "--dump-dom")
    title = dom.split("<title>")[1].split("</title>")[0]
    time, x, y, z = (float(part) for part in title.replace(" s ", " ").split())
    assert time == pytest.approx(0.4, abs=0.003)  # the middle of the axis
    assert x == pytest.approx(1.95, abs=0.06)  # of the nearest pose
    assert (y, z) == pytest.approx((0, 0), abs=0.01)


def test_a_click_sorts_the_table_of_a_batch(tmp_path):
    page = write_batch_page(tmp_path, batch(tmp_path))
    script = """const head = [...document.querySelectorAll('th')].find(h => h.textContent === 'lost, s');
      head.querySelector('button').click(); head.querySelector('button').click();
      document.title = [...document.querySelectorAll('tbody tr')].map(r => r.cells[head.cellIndex].textContent).join(' ')"""
    assert "<title>2 1</title>" in browse(acted(page, script), tmp_path, "--dump-dom")
