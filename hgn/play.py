"""python -m hgn.play: shows a scene in the browser, live (pour, drag obstacles, go back, save), or a rollout file.

Prints the page's address, which contains a token. Ctrl-C ends the program.
"""

from __future__ import annotations

import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hgn.command import run_command
from hgn.config import DEFAULT_WEIGHTS, SimulatorConfig
from hgn.scene.scene_file import find_scene, load_scene
from hgn.schema import FileName, Port, Positive, from_mapping, require, require_bounds
from hgn.system.extras import require_installed
from hgn.system.files import write_atomically
from hgn.system.loading import loading

if TYPE_CHECKING:
    from hgn.runtime.simulator import Simulator


@dataclass(frozen=True)
class PlayConfig(SimulatorConfig):
    """`python -m hgn.play`: a scene in the browser, live, or a rollout file."""

    weights: str = DEFAULT_WEIGHTS  # a file of python -m hgn.export, or the name of shipped weights
    scene: str = "play"  # a scene file, or the name of one in conf/example
    rollout: str | None = None  # file of hgn.rollout, which is shown instead of a scene
    html: FileName | None = None  # with rollout: file for a page that plays it without a server
    every: Positive[int] = 2  # with html: the page has every `every`-th frame
    host: str = "127.0.0.1"  # address of the server; 0.0.0.0 lets other machines with the token connect
    port: Port = 8080  # port, or the next free one; 0: any free port
    browser: bool = True  # open the page in this machine's browser
    particles: Positive[int] | None = None  # largest number; null: 40,000 on a GPU, 8,000 or the scene's on a CPU
    keep_mb: Positive[int] = 1024  # memory for past frames in MB, for going back and for saving

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.html is None or self.rollout is not None, "html", "left out without rollout", self.html)


def main(mapping: dict[str, Any]) -> int:
    """Serves the page until Ctrl-C, or writes the static page. Returns the exit code."""
    config = from_mapping(PlayConfig, mapping)
    require_installed("viser")
    if config.html is not None:
        return _write_page(config)
    page = film_page(config) if config.rollout is not None else play_page(config)
    try:
        print(page.address, flush=True)
        if config.browser:
            webbrowser.open(page.address)
        page.run()
    except KeyboardInterrupt as interruption:
        if interruption.args:  # another signal; Ctrl-C is the normal end
            raise
    finally:
        page.close()
    return 0


def play_page(config: PlayConfig) -> Any:
    """Returns a `hgn.viewer.page.PlayPage` of a scene. Raises ConfigError as loading and simulating the scene do."""
    path = find_scene(config.scene)
    scene = load_scene(path)  # before PyTorch and the weights, so that a mistake in it is answered early
    with loading():
        from hgn.runtime.notes import note_on_speed, notes_on_scene
        from hgn.runtime.simulator import Simulator
        from hgn.runtime.weights import shipped_weights
        from hgn.system.device import choose_device
        from hgn.viewer.page import PlayPage
        from hgn.viewer.session import PlaySession

    place = choose_device(config.device)

    def load(weights: str) -> Simulator:
        return Simulator.load(weights, config.device, config.backend, config.precision)

    simulator = load(config.weights)
    print(simulator.backend.note, file=sys.stderr)
    about = simulator.info, Path(config.weights).stem
    for note in (*notes_on_scene(scene, *about), *note_on_speed(scene.velocity_N3, *about)):
        print(note, file=sys.stderr)
    most = config.particles or max(8_000 if place.type == "cpu" else 40_000, scene.particle_count)
    session = PlaySession(simulator, scene, path.parent, most, config.keep_mb << 20, config.weights)
    names = [config.weights, *(shipped for shipped in shipped_weights() if shipped != config.weights)]
    return PlayPage(session, names, load, config.host, config.port)


def film_page(config: PlayConfig) -> Any:
    """Returns a `hgn.viewer.film.FilmPage` of a rollout file. Raises ConfigError for another file."""
    from hgn.scene.rollout_file import read_rollout
    from hgn.viewer.film import FilmPage

    assert config.rollout is not None
    return FilmPage(read_rollout(config.rollout), config.host, config.port, Path(config.rollout).name)


def _write_page(config: PlayConfig) -> int:
    from hgn.scene.rollout_file import read_rollout
    from hgn.viewer.film import film_html

    assert config.rollout is not None and config.html is not None
    path = Path(config.html)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, film_html(read_rollout(config.rollout), config.every).encode())
    print(path)
    return 0


if __name__ == "__main__":
    run_command(main, "play")
