from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from stable_baselines3.common.logger import configure

from benchmarks.film import draw_posterior, read_events, read_posterior, shrink
from famle_agent.monitoring.tensorboard import encode_gif, log_values, scalar

README_FILM = Path(__file__).parents[2] / "docs" / "pictures" / "ant.gif"


def test_film_gets_smaller_and_keeps_its_pictures_and_its_speed(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, 48, 64, 3), dtype=np.uint8)
    (tmp_path / "long.gif").write_bytes(encode_gif(list(frames), fps=5))
    shrink(tmp_path / "long.gif", tmp_path / "short.gif", width=32, colours=8)
    with Image.open(tmp_path / "short.gif") as film:
        assert (film.size, film.n_frames, film.info["duration"]) == ((32, 24), 3, 200)
        assert len(film.convert("RGB").getcolors()) <= 8
    assert {path.name for path in tmp_path.iterdir()} == {"long.gif", "short.gif"}


def test_belief_is_read_as_it_was_logged_and_drawn(tmp_path: Path) -> None:
    logger = configure(str(tmp_path / "tb"), ["tensorboard"])
    for step, p in enumerate((0.0, 0.5, 1.0)):
        log_values(logger, [scalar("posterior/intact", 1 - p), scalar("posterior/joint 2 dead", p)], 10 * step)
    logger.close()
    belief = read_posterior(read_events(tmp_path / "tb"))
    np.testing.assert_allclose(belief["joint 2 dead"], [(0, 0.0), (10, 0.5), (20, 1.0)])
    np.testing.assert_allclose(belief["intact"], [(0, 1.0), (10, 0.5), (20, 0.0)])
    draw_posterior(belief, 1, tmp_path / "belief.png")
    with Image.open(tmp_path / "belief.png") as picture:
        assert min(picture.size) > 100


def test_film_of_the_readme_loads_at_once() -> None:
    assert README_FILM.stat().st_size < 2e6
    with Image.open(README_FILM) as film:
        assert film.n_frames > 40
