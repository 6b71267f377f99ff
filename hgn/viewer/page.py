"""Serves the page of `hgn.play`: one session with its buttons, shared by any number of viewers.

The page queues the actions of viewers and runs them between two frames, so that the server's event loop never waits for
a frame. Of several moves of one obstacle only the last runs. Viewers who reconnect see the present state.

Viewers are not trusted: a raw message may contain any value. Values are clamped to the range of their sliders, weights
must be in the list, and every error of an action becomes a message to its viewer.
"""

import itertools
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from hgn.config import MESH_SUFFIXES, OBSTACLE_SHAPES
from hgn.runtime.divergence import DivergedError
from hgn.runtime.simulator import Simulator
from hgn.scene.material import MATERIALS
from hgn.scene.rollout_file import write_rollout
from hgn.scene.scene_file import ObstacleEntry
from hgn.schema import ConfigError, require, triple
from hgn.viewer.placed import PlacedObstacle, plain
from hgn.viewer.session import PlaySession, Spout
from hgn.viewer.stage import StageView, quaternion
from hgn.viewer.viser_compat import clamped, require_taken, start_server, stop_server, updates

STATUS_S = 0.25  # seconds between two updates of frame and speed
BACK_S = {"a frame": 0.0, "1 s": 1.0, "5 s": 5.0}
TURN_DEGREES = 360.0  # rotation for a drag across the whole window
MAXIMUM_UPLOAD_BYTES = 64 << 20  # bytes of one mesh file
MAXIMUM_ACTIONS = 64  # actions that may wait for the next frame; further ones are dropped
ACTIONS_S = 0.1  # the next frame comes before the actions that follow once actions have taken this time
ABOUT = {
    "mechanics": "any motion and gravity; free flight is exact",
    "own_physics": "pools, dams, slopes, small and large bodies; resting material creeps",
    "obstacles_small": "fast on a CPU; starts at rest, gravity 9.8 downwards; some particles float or pass obstacles",
}
HELP = """
**Shift + drag** on the floor pours, **Shift + click** drops a ball.
**Drag** an obstacle to move it, **Ctrl/⌘ + drag** to turn it, **click** to choose it.
Elsewhere the mouse moves the camera.
"""


class PlayPage:
    """Serves a session's page. `run` simulates in the thread that calls it; `close` ends the server."""

    def __init__(
        self,
        session: PlaySession,
        weights: Sequence[str] = (),
        load: Callable[[str], Simulator] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Takes the names of `weights` that viewers can choose. `load` makes a simulator from such a name.

        Raises ConfigError for a host that is not an address of this machine.
        """
        self.server, self.address = start_server(host, port, "HGN")
        self.session, self.load = session, load
        self.names = tuple(weights) or (session.weights or "own",)
        self.rate = session.simulator.frame_rate_hz
        spacing = session.cell_size / session.particles_per_cell ** (1 / 3)
        self.stage = StageView(self.server, session.domain_size, spacing)
        self.ended, self.playing, self.steps = threading.Event(), True, 0
        self.diverged = False  # whether the page paused because the simulation diverged
        self.limited = False  # whether viewers were notified that this drag has reached the limit of particles
        self.actions: dict[object, tuple[Callable[[], Any], Any]] = {}
        self._queueing = threading.Lock()
        self.meshes: dict[int, viser.MeshHandle] = {}
        self.shown: dict[int, PlacedObstacle] = {}
        self.chosen: int | None = None
        self._numbers = itertools.count()
        self.frames_a_second = 0.0
        self._add_buttons()
        self._add_mouse()
        self._show()
        self._show_status()

    # between the viewers and the session

    def do(self, action: Callable[[], Any], client: viser.ClientHandle | None = None, key: object = None) -> None:
        """Queues an action for the time before the next frame. Of several actions with one key only the last runs."""
        with self._queueing:
            key = next(self._numbers) if key is None else key
            self.actions.pop(key, None)
            if len(self.actions) < MAXIMUM_ACTIONS:
                self.actions[key] = action, client

    def _present(self, client: viser.ClientHandle | None) -> list[Any]:
        """Returns a viewer, or all viewers, without those who have left. viser warns of messages to these."""
        clients = self.server.get_clients()
        return list(clients.values()) if client is None else [client][: client.client_id in clients]

    def _do_some(self) -> bool:
        """Runs waiting actions of present viewers until they have taken ACTIONS_S. Returns whether there were any."""
        begin, any_waited = time.monotonic(), bool(self.actions)
        while self.actions and time.monotonic() - begin < ACTIONS_S:
            with self._queueing:
                key = next(iter(self.actions))
                action, client = self.actions.pop(key)
            left = client is not None and not self._present(client)
            if left and key != "pour":  # it may close the spout
                continue
            before = self.session.undoable
            try:
                action()
            except (ConfigError, DivergedError, OSError) as error:
                self.session.undoable = before  # what was refused is no step of Undo
                self._notify(str(error), client)
            # A file or a value of one viewer must not end the session of all viewers.
            except Exception as error:  # noqa: BLE001
                traceback.print_exception(error, file=sys.stderr)
                self._notify(f"failed: {type(error).__name__}: {error}", client)
        return any_waited

    def _notify(self, message: str, client: viser.ClientHandle | None = None) -> None:
        for one in self._present(client):
            updates(partial(one.add_notification, "HGN", message, auto_close_seconds=10))

    def run(self) -> None:
        """Simulates, at most in real time, until `close`. Waits while there are no viewers."""
        due = updated = time.monotonic()
        frames, shown = 0, True
        while not self.ended.is_set():
            changed = self._do_some() or not shown
            if (self.playing and self.server.get_clients()) or self.steps:
                self.steps = max(0, self.steps - 1)
                try:
                    self.session.step()
                except Exception as error:  # noqa: BLE001 - one viewer's particles must not end the session either
                    if not isinstance(error, DivergedError):
                        traceback.print_exception(error, file=sys.stderr)
                    self.playing, self.diverged = False, True
                    self._notify(f"{error}; paused a frame before. Press Back by or Restart")
                frames, changed = frames + 1, True
                if self.session.spout is not None and self.session.full:
                    self._end_pouring()
            if changed:
                shown = updates(self._show)
            now = time.monotonic()
            if now - updated >= STATUS_S:
                self.frames_a_second = frames / (now - updated)
                updated, frames = now, 0
                updates(self._show_status)
            due = max(due + 1 / self.rate, now)
            self.ended.wait(max(0.0, due - now) if due > now else 0)

    def close(self) -> None:
        """Ends the server after the end of `run`. `ended.set()` ends `run` from another thread."""
        self.ended.set()
        stop_server(self.server)

    # the display

    def _show(self) -> None:
        session = self.session
        self.stage.show(session.newest.position_N3, session.materials())
        obstacles = {obstacle.body.number: obstacle for obstacle in session.obstacles}
        for number in self.meshes.keys() - obstacles.keys():
            self.meshes.pop(number).remove()
            del self.shown[number]
        for number, obstacle in obstacles.items():
            if number not in self.meshes:
                self._add_mesh(obstacle)
            elif self.shown[number] is not obstacle:
                self.meshes[number].position = obstacle.position
                self.meshes[number].wxyz = quaternion(obstacle.rotation_33)
            self.shown[number] = obstacle
        if self.chosen not in obstacles:
            self.chosen = None

    def _show_status(self) -> None:
        session = self.session
        speed = f"**{self.frames_a_second:.0f}** frames a second · **{len(session.newest.position_N3):,}** particles"
        backend = f"{plain(Path(session.weights).name)} on {session.simulator.device.type}"
        self.status.content = f"{speed}\n\nframe {session.frame} · {backend}"
        self.play_button.label = "Pause" if self.playing else "Play"
        self.gravity.value = session.gravity
        self.about.content = ABOUT.get(session.weights, "weights of your own")
        name = self.shown[self.chosen].body.name if self.chosen is not None else "none"
        self.chosen_text.content = f"chosen: {name}"

    # actions of the viewers

    def _add_buttons(self) -> None:
        gui, session = self.server.gui, self.session
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.set_panel_label("HGN")
        self.status = gui.add_markdown("")
        self.play_button = gui.add_button("Pause")
        step = gui.add_button("Step")
        back = gui.add_button_group("Back by", tuple(BACK_S))
        restart = gui.add_button("Restart")
        undo = gui.add_button("Undo")
        with gui.add_folder("Save"):
            save_scene = gui.add_button("Scene (YAML, zip)")
            save_rollout = gui.add_button("Rollout (VTKHDF)")
        with gui.add_folder("Pour"):
            self.material = gui.add_dropdown("Material", self._materials())
            self.diameter = gui.add_slider("Diameter", 0.02, 0.3, 0.01, 0.08)
            slow = session.simulator.device.type == "cpu"  # one stroke would fill a CPU's limit of particles
            self.speed = gui.add_slider("Speed", 0.0, 3.0, 0.1, 0.5 if slow else 1.0)
            self.height = gui.add_slider("Height", 0.1, 1.0, 0.05, 0.75)
            gui.add_markdown(HELP)
        with gui.add_folder("Obstacles"):
            self.shape = gui.add_dropdown("Shape", OBSTACLE_SHAPES)
            self.size = gui.add_slider("Size", 0.05, 0.6, 0.01, 0.3)
            add = gui.add_button("Add")
            upload = gui.add_upload_button("Own mesh", mime_type=",".join(MESH_SUFFIXES))
            self.chosen_text = gui.add_markdown("")
            remove = gui.add_button("Remove the chosen")
        with gui.add_folder("World"):
            self.gravity: Any = gui.add_vector3("Gravity", session.gravity, step=0.1)
            self.weights: Any = gui.add_dropdown("Weights", self.names)
            self.about = gui.add_markdown("")

        def one_step() -> None:
            self.play(False)
            self.steps = 1

        def go_back(seconds: float) -> None:
            self.play(False)
            frames = max(1, round(seconds * self.rate))
            session.rewind(max(session.recording.earliest, session.frame - frames))

        def set_gravity(gravity: tuple[float, float, float]) -> None:
            session.remember()
            session.set_gravity(gravity)

        self.play_button.on_click(lambda event: self.do(lambda: self.play(not self.playing), event.client))
        step.on_click(lambda event: self.do(one_step, event.client))
        restart.on_click(lambda event: self.do(self.restart, event.client))
        undo.on_click(lambda event: self.do(session.undo, event.client))
        add.on_click(lambda event: self.do(self._add_shape, event.client))
        remove.on_click(lambda event: self.do(self._remove_chosen, event.client))
        save_scene.on_click(lambda event: self.do(lambda: self._send_scene(event), event.client))
        save_rollout.on_click(lambda event: self.do(lambda: self._send_rollout(event), event.client))

        @back.on_click
        def _(event: Any) -> None:
            seconds = BACK_S[event.target.value]
            self.do(lambda: go_back(seconds), event.client)

        @self.gravity.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                gravity = triple(event.target.value)
                self.do(lambda: set_gravity(gravity), event.client, "gravity")

        @self.weights.on_update
        def _(event: Any) -> None:
            if event.client is not None and self.load is not None:
                name = event.target.value
                self.do(lambda: self._use(name), event.client, "weights")

        @upload.on_upload
        def _(event: Any) -> None:
            file = event.target.value
            if "upload" in self.actions:
                self._notify("another mesh is still being read; upload it again", event.client)
            else:
                self.do(lambda: self._add_file(file.name, file.content), event.client, "upload")

    def play(self, playing: bool) -> None:
        """Continues or pauses on a viewer's request."""
        self.playing, self.diverged = playing, False

    def restart(self) -> None:
        """Starts again from the beginning. A pause by a viewer stays; a pause after divergence ends."""
        self.session.restart()
        self.playing, self.diverged = self.playing or self.diverged, False

    def _use(self, name: str) -> None:
        assert self.load is not None
        try:
            require(name in self.names, "weights", f"one of {', '.join(self.names)}", name)
            self.session.use_weights(self.load(name), name)
        except ConfigError:
            self.weights.value = self.session.weights
            raise
        self.material.options = self._materials()

    def _materials(self) -> tuple[str, ...]:
        """Returns the materials that can be poured: the materials of the weights that scenes can have too."""
        return tuple(name for name in self.session.simulator.materials if name in MATERIALS)

    def _add_shape(self) -> None:
        size = clamped(self.size)
        entry = ObstacleEntry(shape=self.shape.value, size=size, position=self.session.free_place(size))
        self.session.remember()
        self.chosen = self.session.add_obstacle(entry).body.number

    def _add_file(self, name: str, content: bytes) -> None:
        """Adds a mesh at a free place, scaled to the size of the slider."""
        require("\0" not in name, "mesh", "a name without null characters", name)
        file = Path(name).name
        require(Path(file).suffix.lower() in MESH_SUFFIXES, "mesh", f"one of {', '.join(MESH_SUFFIXES)}", file)
        rule = f"at most {MAXIMUM_UPLOAD_BYTES >> 20} MiB"
        require(len(content) <= MAXIMUM_UPLOAD_BYTES, f"mesh {file}", rule, f"{len(content) / 2**20:.1f} MiB")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{plain(Path(file).stem)}{Path(file).suffix}"
            path.write_bytes(content)
            try:
                size = clamped(self.size)
                place = self.session.free_place(size)
                self.session.remember()
                added = self.session.add_mesh(path, size, place)
            except ConfigError as error:  # the message must not name the server's folder
                raise ConfigError(str(error).replace(str(path), file)) from None
        self.chosen = added.body.number

    def _remove_chosen(self) -> None:
        if self.chosen is not None:
            self.session.remember()
            self.session.remove_obstacle(self.chosen)

    def _send_scene(self, event: Any) -> None:
        require_taken(event.client)
        event.client.send_file_download("scene.zip", self.session.scene_archive(), save_immediately=True)

    def _send_rollout(self, event: Any) -> None:
        require_taken(event.client)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rollout.vtkhdf"
            write_rollout(path, self.session.rollout())
            event.client.send_file_download(path.name, path.read_bytes(), save_immediately=True)

    # the mouse

    def _add_mouse(self) -> None:
        room = self.stage.room

        @room.on_drag("left", modifier="shift")
        async def _(event: viser.SceneNodeDragEvent) -> None:
            eye_3 = np.array(event.client.camera.position)
            ray_3 = None if event.phase == "end" else np.array(event.end_position) - eye_3
            self.do(lambda: self._pour(eye_3, ray_3), event.client, "pour")

        @self.server.scene.on_click(modifier="shift")
        def _(event: viser.SceneClickEvent) -> None:
            self.do(lambda: self._drop(np.array(event.ray_origin), np.array(event.ray_direction)), event.client)

    def _pour(self, origin_3: np.ndarray, direction_3: np.ndarray | None) -> None:
        """Opens the spout at the target of the ray, or closes it without a ray.

        At the limit of particles it stays closed until the next drag. Otherwise each motion of the mouse would cause
        one more message, and one more step of Undo.
        """
        if direction_3 is None:
            self.session.spout, self.limited = None, False
        elif self.session.full:
            if not self.limited:
                self._end_pouring()
        else:
            spout = self._spout(origin_3, direction_3)
            if self.session.spout is None:
                self.session.remember()
            self.session.spout = spout

    def _end_pouring(self) -> None:
        self.session.spout, self.limited = None, True
        self._notify(self._limit())

    def _drop(self, origin_3: np.ndarray, direction_3: np.ndarray) -> None:
        spout = self._spout(origin_3, direction_3)
        if self.session.full:
            self._notify(self._limit())
            return
        self.session.remember()
        if not self.session.drop(spout.material, spout.position, spout.diameter, spout.speed):
            raise ConfigError("there is no room for a ball here")

    def _limit(self) -> str:
        return f"no more than {self.session.maximum_particles:,} particles, to stay fast; particles=N allows more"

    def _spout(self, origin_3: np.ndarray, direction_3: np.ndarray) -> Spout:
        """Returns a spout above the point where a ray meets the floor or leaves through a wall.

        Raises ConfigError for a ray that is not finite or has no direction.
        """
        high_3 = np.array(self.session.domain_size)
        usable = np.isfinite(origin_3).all() and np.isfinite(direction_3).all() and direction_3.any()
        require(bool(usable), "ray", "finite, with a direction", [*origin_3.tolist(), *direction_3.tolist()])
        along_3 = direction_3 != 0
        plane_3 = np.where(direction_3 > 0, high_3, 0.0)
        distance = ((plane_3 - origin_3)[along_3] / direction_3[along_3]).min()
        hit_3 = origin_3 + distance * direction_3
        x, _, z = np.clip(hit_3, 0, high_3).tolist()
        height = clamped(self.height) * self.session.domain_size[1]
        return Spout((x, height, z), self.material.value, clamped(self.diameter), clamped(self.speed))

    def _add_mesh(self, obstacle: PlacedObstacle) -> None:
        number = obstacle.body.number
        rotation = quaternion(obstacle.rotation_33)
        mesh = self.stage.add_obstacle(obstacle.body.name, obstacle.body.mesh, obstacle.position, rotation)
        self.meshes[number] = mesh
        grabbed: list[tuple[PlacedObstacle, Any]] = []  # the obstacle at the drag's start, and the first event

        def drag(event: Any, moved: Callable[[PlacedObstacle, Any], PlacedObstacle]) -> None:
            if number not in self.shown:
                return
            if event.phase == "start":
                self.do(self.session.remember, event.client)
                grabbed[:] = [(self.shown[number], event)]
                self.chosen = number
            if grabbed:
                placed = moved(*grabbed[0])
                self.do(lambda: self.session.move_obstacle(placed), event.client, number)

        @mesh.on_click
        async def _(event: Any) -> None:
            self.chosen = number

        @mesh.on_drag("left")
        async def _(event: viser.SceneNodeDragEvent) -> None:
            def moved(before: PlacedObstacle, begin: Any) -> PlacedObstacle:
                position = np.array(before.position) + event.end_position - begin.start_position
                return replace(self.shown[number], position=triple(position))

            drag(event, moved)

        @mesh.on_drag("left", modifier="cmd/ctrl")
        async def _(event: viser.SceneNodeDragEvent) -> None:
            def turned(before: PlacedObstacle, begin: Any) -> PlacedObstacle:
                degrees = TURN_DEGREES * (event.end_screen_pos[0] - begin.end_screen_pos[0])
                return replace(before.turned(degrees), position=self.shown[number].position)

            drag(event, turned)
