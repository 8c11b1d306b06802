from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PIL import Image
from stable_baselines3.common.logger import configure

from benchmarks.screenshots import Args, main, photograph

PICTURES = Path(__file__).parents[2] / "docs" / "pictures"
BROWSER = f"""#!{sys.executable}
import sys
from urllib.request import urlopen

from PIL import Image

runs = urlopen(sys.argv[-1].partition("?")[0] + "data/runs").read()
path = next(arg.partition("=")[2] for arg in sys.argv if arg.startswith("--screenshot="))
Image.new("RGB", (len(runs), 7)).save(path, "PNG")
"""
"""Stands in for Chromium: draws a picture as wide as TensorBoard's list of runs is long."""


@pytest.mark.slow
def test_pictures_are_of_the_pages_of_a_log(tmp_path: Path) -> None:
    logger = configure(str(tmp_path / "log" / "with_adaptation"), ["tensorboard"])
    logger.record("posterior/intact", 1.0)
    logger.dump(0)
    logger.close()
    browser = tmp_path / "browser"
    browser.write_text(BROWSER)
    browser.chmod(0o755)
    photograph(tmp_path / "log", tmp_path / "out", str(browser))
    for title in ("scalars", "images", "text"):
        with Image.open(tmp_path / "out" / f"tensorboard-{title}.png") as picture:
            assert picture.size == (len('["with_adaptation"]'), 7)


@pytest.mark.slow
def test_browser_that_fails_says_why_and_leaves_no_picture(tmp_path: Path) -> None:
    browser = tmp_path / "browser"
    browser.write_text(f"#!{sys.executable}\nraise SystemExit('no display')\n")
    browser.chmod(0o755)
    (tmp_path / "log").mkdir()
    with pytest.raises(ChildProcessError, match=r"no picture of scalars, status 1: no display"):
        photograph(tmp_path / "log", tmp_path / "out", str(browser))
    assert not list((tmp_path / "out").glob("*.png"))


def test_missing_browser_is_named_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"'no-browser'.*--chromium"):
        main(Args(tmp_path / "out", "no-browser"))
    assert not any(tmp_path.iterdir())


def test_pictures_of_the_manual_load_at_once() -> None:
    pictures = list(PICTURES.glob("tensorboard-*.png"))
    assert len(pictures) == 3
    assert max(path.stat().st_size for path in pictures) < 150_000
