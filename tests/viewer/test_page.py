"""The page in a real browser, headless, one session of it for all tests; skipped where there is none."""

import asyncio
import contextlib
import errno
import io
import itertools
import random
import re
import shutil
import threading
import time
import urllib.error
import urllib.request
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import numpy as np
import pytest
import torch
import yaml
from network.states import network_of, silent
from PIL import Image
from processes import PATIENCE_S
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from hgn.render.renderer import PARTICLE_COLORS, to_bytes
from hgn.runtime.simulator import Simulator
from hgn.scene.material import MATERIALS
from hgn.scene.rollout_file import read_rollout
from hgn.scene.scene import Scene
from hgn.scene.scene_file import load_scene

pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
from viewer import soak

from hgn.schema import ConfigError
from hgn.viewer import film
from hgn.viewer.film import film_html
from hgn.viewer.page import PlayPage
from hgn.viewer.session import PlaySession
from hgn.viewer.stage import StageView
from hgn.viewer.viser_compat import start_server, stop_server

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZE = (900, 600)
CONF = Path(__file__).parents[2] / "conf"
# viser keeps its event loop's threads and sockets until the garbage collector comes
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def floating():
    """Relative inputs and an output of zero: particles without gravity stay where they are."""
    small = {"width": 16, "levels": 1, "message_passing_steps": 1}
    return Simulator(silent(network_of(torch.float32, **small, inputs="relative")), 60.0, "cpu")


def without_shadows(server):
    """Disables shadows and reflections, which are slow in a browser without a GPU. Returns the server."""
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(hdri=None)
    return server


@pytest.fixture(scope="module")
def play():
    block_N3 = 0.4 + 0.2 * np.random.default_rng(0).random((600, 3)).astype(np.float32)
    cone = {"shape": "cone", "size": 0.3, "position": (0.5, 0.5, 0.5)}
    still = (0.0, 0.0, 0.0)
    scene = Scene(
        block_N3,
        0 * block_N3,
        np.zeros(600, np.uint8),
        cell_size=1 / 32,
        gravity=still,
        specification={"obstacles": [cone]},
    )
    session = PlaySession(floating(), scene, weights="floating")
    page = PlayPage(session, ("floating", "other"), lambda name: floating(), port=0)
    page.rate = 8.0  # frames a second: simulation and browser share a core
    without_shadows(page.server)
    thread = threading.Thread(target=page.run)
    thread.start()
    yield page
    page.ended.set()
    thread.join()
    page.close()


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"no browser is installed: one of {', '.join(BROWSERS)}")
    options = ["--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=options, headless=True)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def viewer(browser, play):
    """A viewer's page, once its canvas shows more than one colour."""
    size = {"width": SIZE[0], "height": SIZE[1]}
    page = browser.new_context(viewport=size, device_scale_factor=0.25).new_page()
    page.set_default_timeout(300_000)
    page.goto(play.address)
    page.wait_for_selector("canvas")
    until(lambda: len(np.unique(pixels(page) @ (65536, 256, 1))) > 50, every=0.5)
    return page


def pixels(page):
    return np.asarray(Image.open(io.BytesIO(page.screenshot(scale="css"))).convert("RGB")).astype(int)


def until(condition, every=0.05):
    """Waits for a condition, patiently: the browser draws on a shared core."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(every)


def done(page, action):
    """Done between two frames, and the frame behind it, too."""
    for each in (action, lambda: None):
        over = threading.Event()
        page.do(lambda each=each, over=over: (each(), over.set()))
        assert over.wait(PATIENCE_S)


def until_blue(page):
    """Waits until more than 300 pixels are water's, where the domain is; sliders and buttons are blue too."""

    def drawn():
        red, green, blue = np.moveaxis(pixels(page)[100:400, 100:550], -1, 0)
        return ((blue > red + 60) & (blue > green + 25)).sum() > 300

    until(drawn, every=0.5)


def on_screen(play, point):
    """Where the first viewer's camera sees a point, in pixels."""
    camera = next(iter(play.server.get_clients().values())).camera
    forward = np.asarray(camera.look_at) - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right /= np.linalg.norm(right)
    offset = np.asarray(point) - camera.position
    depth = offset @ forward
    scale = SIZE[1] / 2 / np.tan(camera.fov / 2) / depth
    return SIZE[0] / 2 + scale * (offset @ right), SIZE[1] / 2 - scale * (offset @ np.cross(right, forward))


def caught_up(page, play):
    """Waits until the browser has drawn all that the server sent before."""
    done(play, lambda: None)
    mark = play.server.gui.add_markdown(f"mark {time.monotonic_ns()}")
    page.get_by_text(mark.content).wait_for(state="attached")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    mark.remove()


def drag(page, begin, end, key=None, held_until=lambda: True):
    """Moves the mouse in steps, with the button pressed until a condition is true. Meanwhile the mouse moves back and
    forth by a pixel: a busy browser may take the whole path for a drag's first motion, whose position it sends only
    with the next one."""
    if key:
        page.keyboard.down(key)
    page.mouse.move(*begin)
    page.mouse.down()
    for share in np.linspace(0, 1, 6):
        page.mouse.move(*(a + share * (b - a) for a, b in zip(begin, end, strict=True)))
        page.wait_for_timeout(50)
    tremble = itertools.cycle((1, 0))
    until(lambda: held_until() or page.mouse.move(end[0] + next(tremble), end[1]))
    page.mouse.up()
    if key:
        page.keyboard.up(key)


def press(page, name):
    page.get_by_role("button", name=name, exact=True).first.click()


def test_points_are_drawn(viewer, play):
    """The page shows the water where the camera sees it, the numbers of particles and frames a second."""
    until_blue(viewer)
    x, y = (int(value) for value in on_screen(play, (0.5, 0.56, 0.5)))
    around = pixels(viewer)[y - 60 : y + 60, x - 60 : x + 60]
    assert ((around[..., 2] > around[..., 0] + 60).mean()) > 0.02
    until(lambda: re.search(r"[1-9]\d* frames a second · 600 particles", viewer.inner_text("body")))


def test_a_drag_with_shift_pours(viewer, play):
    """Particles of the chosen material enter above the mouse's target while the button is pressed, and none
    afterwards."""
    sliders: Any = play
    sliders.speed.value, sliders.diameter.value = 0.2, 0.2  # slow: nothing stops it before it is out of the domain
    begin, end = on_screen(play, (0.28, 0.0, 0.3)), on_screen(play, (0.32, 0.0, 0.3))
    drag(viewer, begin, end, "Shift", lambda: len(play.session.newest.position_N3) > 610)
    until(lambda: play.session.spout is None)
    done(play, lambda: None)
    count, frame = len(play.session.newest.position_N3), play.session.frame
    until(lambda: play.session.frame > frame + 3)
    done(play, lambda: play.play(False))
    assert len(play.session.newest.position_N3) == count
    poured_A3 = play.session.newest.position_N3[600:]
    assert (np.abs(poured_A3[:, [0, 2]] - (0.3, 0.3)) < 0.15).all()
    until(lambda: f"{count:,} particles" in viewer.inner_text("body"))
    press(viewer, "Restart")
    until(lambda: len(play.session.materials()) == 600)
    press(viewer, "Play")
    until(lambda: play.session.frame > 3)


def test_an_obstacle_that_is_dragged_moves(viewer, play):
    """On screen by as much as the mouse, for the network as for the eye; with Ctrl it turns about the vertical."""
    (before,) = play.session.obstacles
    begin = on_screen(play, (0.5, 0.5, 0.5))

    def shown():
        moved_3 = np.subtract(play.session.obstacles[0].position, before.position)
        return on_screen(play, tuple(np.add((0.5, 0.5, 0.5), moved_3)))

    end = begin[0] + 80, begin[1]
    drag(viewer, begin, end, held_until=lambda: shown() == pytest.approx(end, abs=8))
    (after,), there = play.session.obstacles, shown()
    grid = play.session.live.scenes[0].obstacle_grid
    middle_3 = (grid.cell_K3 + 0.5).mean(axis=0) * grid.cell_size - np.subtract(after.position, (0, 0.03, 0))
    assert np.abs(middle_3).max() < 0.06
    turned = lambda: play.session.obstacles[0].rotation[1] == pytest.approx(-36, abs=4)  # noqa: E731
    caught_up(viewer, play)
    drag(viewer, there, (there[0] - 90, there[1]), "Control", held_until=turned)


def test_pause_step_and_back(viewer, play, monkeypatch):
    """Pause stops the scene, Step simulates one frame, Back removes frames and pauses, and Play continues."""
    ways, rewind = [], play.session.rewind  # of each Back: a browser under load may send a click twice
    monkeypatch.setattr(play.session, "rewind", lambda to: (ways.append(play.session.frame - to), rewind(to)))
    press(viewer, "Pause")
    until(lambda: not play.playing)
    frame = play.session.frame
    press(viewer, "Step")
    until(lambda: play.session.frame > frame)
    done(play, lambda: None)
    assert play.session.frame == frame + 1
    press(viewer, "a frame")
    until(lambda: play.session.frame <= frame)
    press(viewer, "Play")
    until(lambda: play.session.frame > 2 * play.rate + 1)
    single = len(ways)
    press(viewer, "1 s")
    until(lambda: not play.playing)
    done(play, lambda: None)
    frame = play.session.frame
    press(viewer, "1 s")
    until(lambda: play.session.frame <= frame - play.rate)
    done(play, lambda: None)
    assert set(ways[:single]) == {1} and set(ways[single:]) == {play.rate} and len(ways) >= single + 2
    press(viewer, "Play")
    until(lambda: play.playing)


def test_scene_and_rollout_are_taken_away(viewer, play, tmp_path):
    """Scene and rollout can be downloaded. The scene file contains the present state, and the rollout its frames."""
    with viewer.expect_download() as download:
        press(viewer, "Scene (YAML, zip)")
    zipfile.ZipFile(download.value.path()).extractall(tmp_path)
    assert yaml.safe_load((tmp_path / "scene.yaml").read_text())["cell_size"] == 1 / 32
    assert load_scene(tmp_path / "scene.yaml").particle_count == len(play.session.newest.position_N3)
    with viewer.expect_download() as download:
        press(viewer, "Rollout (VTKHDF)")
    download.value.save_as(tmp_path / "a.vtkhdf")
    rollout = read_rollout(tmp_path / "a.vtkhdf")
    assert rollout.particle_count == 600 and rollout.frame_count > 3


def test_own_meshes(viewer, play):
    """An uploaded mesh is placed without particles inside, with the size of the slider. A file that is no mesh causes a
    message."""
    count = len(play.session.obstacles)
    field = viewer.locator("input[type=file]")
    field.set_input_files(files=[{"name": "a.obj", "mimeType": "", "buffer": b"no mesh"}])
    viewer.get_by_text("must contain triangles").wait_for()
    field.set_input_files(str(CONF / "example" / "ramp.obj"))
    until(lambda: len(play.session.obstacles) == count + 1)
    vertex_V3 = play.session.obstacles[-1].mesh().vertex_V3
    low, high = vertex_V3.min(axis=0), vertex_V3.max(axis=0)
    middle_3 = 0.5 * (low + high)
    assert not (np.abs(play.session.newest.position_N3 - middle_3) < 0.15).all(axis=1).any()
    assert (high - low).max() == pytest.approx(0.3)
    press(viewer, "Remove the chosen")
    until(lambda: len(play.session.obstacles) == count)
    press(viewer, "Undo")
    until(lambda: len(play.session.obstacles) == count + 1)
    press(viewer, "Undo")
    until(lambda: len(play.session.obstacles) == count)


def test_two_viewers_and_a_lost_connection(viewer, play):
    """A second viewer, without a browser, receives the same scene, and its pause affects both. When all connections
    break, the scene continues, and the page connects again."""
    second = soak.Viewer(random.Random(0))

    async def pause():
        async with second.connected(play.address):
            while not second.frames:
                await asyncio.sleep(0.05)
            await second.press("Pause")

    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, pause()).result()
    until(lambda: not play.playing)
    until(lambda: "Play" in viewer.inner_text("body").splitlines())
    press(viewer, "Play")
    until(lambda: play.playing)
    frame, lost = play.session.frame, set(play.server.get_clients())
    play.server._websock_server.disconnect_all_clients()
    until(lambda: play.server.get_clients().keys() - lost)
    until(lambda: play.session.frame > frame)
    press(viewer, "Pause")
    until(lambda: not play.playing)
    until_blue(viewer)


def test_who_may_read_the_page(play, caplog):
    """Neither the page nor the websocket answers without the token or with another one. The default host is loopback.
    Cookies of other programs on this machine do not close the page. A name that no file can have returns 404."""
    bare, token = urljoin(play.address, "/"), urlsplit(play.address).path.strip("/")
    assert bare.startswith("http://127.0.0.1:") and play.address == f"{bare}{token}/" and len(token) > 20
    for address in (bare, f"{bare}wrong/", f"{bare}?token={token}"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address)
    for name in ("a" * 300, "a/" * 3000, "%FF" * 100, "%00"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(play.address + name)
    with pytest.raises(InvalidStatus, match="403"):
        connect(bare.replace("http", "ws"))
    with pytest.raises(ConfigError, match=r"host must be an address of this machine, got '192.0.2.1'"):
        start_server("192.0.2.1", 0, "HGN")
    for cookies in ("user@host=1", "a/b=1", 'x={"a":1,"b":2}', "path=1", "flag"):
        with urllib.request.urlopen(urllib.request.Request(play.address, headers={"Cookie": cookies})) as answer:
            assert answer.status == 200
    assert not [record for record in caplog.records if record.exc_info]


def test_stage():
    """Particles of a material that an imported set named have the colour that pictures have for it, or a darker shade.
    Before a flat rollout the camera stands before the middle of the plane, whose box is as deep as a particle."""
    server, _ = start_server("127.0.0.1", 0, "stage")
    try:
        stage = StageView(server, (1.0, 1.0, 1.0), 0.01, materials=(*MATERIALS, "goop"))
        stage.show(np.full((3, 3), 0.5, np.float32), np.array([0, 4, 4]))
        assert [len(cloud.points) for cloud in stage.clouds] == [1, 0, 0, 0, 2]
        shade_N3 = stage.clouds[4].colors / to_bytes(PARTICLE_COLORS[4])
        assert np.ptp(shade_N3, axis=1).max() < 0.02 and (shade_N3 > 0.69).all() and (shade_N3 < 1.01).all()
        StageView(server, (0.8, 0.4, 0.5), 0.01, dimensions=2)
        camera = server.initial_camera
        np.testing.assert_allclose(camera.look_at, (0.4, 0.2, 0.25))
        np.testing.assert_allclose(camera.position[:2], (0.4, 0.2))
        assert camera.position[2] > 0.5
    finally:
        stop_server(server)


def test_a_film_plays_by_itself(viewer, play, tmp_path, monkeypatch):
    """The static page draws the rollout's particles without any server."""

    def start_plain(*given):
        server, address = start_server(*given)
        return without_shadows(server), address

    monkeypatch.setattr(film, "start_server", start_plain)
    path = tmp_path / "film.html"
    path.write_text(film_html(play.session.rollout(), every=10))
    viewer.goto("about:blank")  # else the page's last picture stays until the film draws
    viewer.goto(path.as_uri())
    viewer.wait_for_selector("canvas")
    until_blue(viewer)


@contextlib.contextmanager
def viewed(page):
    """One viewer, without a browser."""
    over = threading.Event()

    async def view():
        async with soak.Viewer(random.Random(0)).connected(page.address):
            while not over.is_set():
                await asyncio.sleep(0.05)

    with ThreadPoolExecutor(1) as pool:
        viewer = pool.submit(asyncio.run, view())
        try:
            yield
        finally:
            over.set()
        viewer.result()


def test_it_runs_while_somebody_looks_and_restarts_as_it_was():
    """No frame is simulated before the first viewer connects or after the last one leaves. Restart continues after a
    divergence, and keeps a viewer's pause. A full disk during a download causes a message and ends nothing."""
    session = PlaySession(floating(), load_scene(CONF / "example/play.yaml"), CONF / "example")
    page = PlayPage(session, port=0)
    thread = threading.Thread(target=page.run)
    thread.start()

    def full():
        raise OSError(errno.ENOSPC, "No space left on device")

    try:
        done(page, lambda: None)
        assert session.frame == 0 and page.playing
        with viewed(page):
            until(lambda: session.frame > 0)
        until(lambda: not page.server.get_clients())
        done(page, lambda: None)
        frame = session.frame
        for _ in range(5):
            done(page, lambda: None)
        assert session.frame == frame and page.playing
        with viewed(page):
            until(lambda: session.frame > frame)
            done(page, lambda: session.drop("water", (0.3, 0.8, 0.3), 0.1, speed=600.0))
            until(lambda: page.diverged)
            assert not page.playing
            done(page, page.restart)
            assert page.playing and not page.diverged
            until(lambda: session.frame > 1)
        done(page, lambda: page.play(False))
        done(page, page.restart)
        assert not page.playing and session.frame == 0
        notes: list[str] = []
        page._notify = lambda message, client=None: notes.append(message)  # type: ignore[method-assign]
        page.do(full)
        done(page, lambda: None)
        assert notes == ["[Errno 28] No space left on device"] and thread.is_alive()
    finally:
        page.ended.set()
        thread.join()
        page.close()
