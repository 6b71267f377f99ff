"""Shows rollout files in the browser: as a page with a slider, in a notebook's cell, or as one static file.

Shape legend: T frames.
"""

import contextlib
import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

import viser

from hgn.render.pictures import rollout_spacing
from hgn.scene.rollout_file import FARTHEST, Rollout
from hgn.schema import require
from hgn.system.files import WRITTEN_BY_HGN
from hgn.viewer.placed import plain
from hgn.viewer.stage import StageView, quaternion
from hgn.viewer.viser_compat import clamped, start_server, stop_server, updates

REST = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class _Film:
    """Draws a rollout's frames on a server's stage."""

    def __init__(self, server: viser.ViserServer, rollout: Rollout) -> None:
        self.rollout = rollout
        small = FARTHEST * max(rollout.domain_size) < 65504  # the largest number in float16
        precision: Literal["float16", "float32"] = "float16" if small else "float32"
        self.stage = StageView(
            server, rollout.domain_size, rollout_spacing(rollout), precision, rollout.materials, rollout.dimensions
        )
        self.moving = []
        for index, obstacle in enumerate(rollout.obstacles):
            mesh = self.stage.add_obstacle(f"{index}_{plain(obstacle.name)}", obstacle, *REST)
            if obstacle.motion is not None:
                self.moving.append((mesh, obstacle.motion))

    def show(self, frame: int) -> None:
        present = self.rollout.present(frame)
        self.stage.show(self.rollout.position_TN3[frame, :present], self.rollout.material_N[:present])
        for mesh, motion in self.moving:
            rotation_33, place_3 = motion.transform(frame / self.rollout.frame_rate_hz)
            mesh.position, mesh.wxyz = tuple(place_3.tolist()), quaternion(rotation_33)


@contextlib.contextmanager
def _recorded(rollout: Rollout, every: int) -> Iterator[Any]:
    """Yields Viser's serializer of a scene, with every `every`-th frame."""
    require(every >= 1, "every", "at least 1", every)
    server, _ = start_server("127.0.0.1", 0, "HGN")
    try:
        film = _Film(server, rollout)
        film.show(0)
        serializer = server.get_scene_serializer()
        for frame in range(0, rollout.frame_count, every):
            film.show(frame)
            serializer.insert_sleep(every / rollout.frame_rate_hz)
        yield serializer
    finally:
        stop_server(server)


def film_html(rollout: Rollout, every: int = 2) -> str:
    """Returns a page that plays every `every`-th frame without a server. Its size is 1 MB plus the positions.

    Raises ConfigError for `every` below 1, and ModuleNotFoundError without the extra `play`.
    """
    with _recorded(rollout, every) as serializer:
        return f"{serializer.as_html()}\n<!-- {WRITTEN_BY_HGN} -->\n"


def show_film(rollout: Rollout, every: int = 2, height: int = 480) -> None:
    """Shows the film in a notebook's cell, `height` pixels high. Outside notebooks it opens the browser.

    Raises the errors of `film_html`.
    """
    with _recorded(rollout, every) as serializer:
        serializer.show(height=height)


class FilmPage:
    """Serves a page with a rollout, a slider over its frames, and a button that plays them."""

    def __init__(self, rollout: Rollout, host: str = "127.0.0.1", port: int = 8080, label: str = "HGN") -> None:
        """Starts the server. Raises ConfigError for a host that is not an address of this machine."""
        self.server, self.address = start_server(host, port, label)
        self.film, self.rollout = _Film(self.server, rollout), rollout
        gui = self.server.gui
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.set_panel_label("HGN")
        self.playing = gui.add_checkbox("Play", True)
        self.speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
        self.slider: Any = gui.add_slider("Frame", 0, max(1, rollout.frame_count - 1), 1, 0)
        self.ended = threading.Event()
        self.film.show(0)

        @self.slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self.film.show(min(int(clamped(self.slider)), rollout.frame_count - 1))

    def run(self) -> None:
        """Plays until a call of `close`."""
        shown = time.monotonic()
        frame = 0.0
        while not self.ended.wait(1 / 60):
            now = time.monotonic()
            passed, shown = now - shown, now
            if not self.playing.value:
                frame = clamped(self.slider)
                continue
            if abs(clamped(self.slider) - int(frame)) > 1:  # a viewer moved the slider
                frame = clamped(self.slider)
            frame = (frame + passed * clamped(self.speed) * self.rollout.frame_rate_hz) % self.rollout.frame_count
            updates(partial(self.film.show, int(frame)))
            self.slider.value = int(frame)

    def close(self) -> None:
        self.ended.set()
        stop_server(self.server)
