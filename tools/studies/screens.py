"""python -m tools.studies.screens [json=FILE]: what showing costs: files for other programs, and a page of hgn.play.

A frame's time is the least of several runs, for other programs may have the processor meanwhile; CPU time stands beside
it. The page is looked at by a headless Chromium, which draws on the same cores.
"""

from __future__ import annotations

import hgn.system.threads  # noqa: F401  # isort: skip  # before torch is loaded

import json
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from hgn.command import run_command
from hgn.render.exchange import fluid_surface, save_rollout
from hgn.runtime.simulator import Simulator
from hgn.scene.rollout_file import Rollout
from hgn.scene.scene_file import find_scene, load_scene
from hgn.schema import OneOrMore, Positive, from_mapping, require_bounds
from hgn.system.files import write_json
from hgn.system.provenance import provenance
from hgn.viewer.page import PlayPage
from hgn.viewer.session import PlaySession

CELL = 1 / 64  # of the data's grid, with 8 particles at rest
SIDE = 16  # particles along the edges of the water whose surface is timed: 4,096
BROWSER = ["--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@dataclass(frozen=True)
class ScreensConfig:
    """`python -m tools.studies.screens`."""

    weights: str = "obstacles_small"
    particles: OneOrMore = 1500  # on the page
    seconds: Positive[int] = 30  # that it is watched for
    repeats: OneOrMore = 5  # of files
    browser: bool = True
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)


def main(mapping: dict[str, Any]) -> int:
    """Prints and stores the rows; returns the exit code."""
    config = from_mapping(ScreensConfig, mapping)
    simulator = Simulator.load(config.weights, device="cpu")
    session = _session(simulator, config.particles)
    page, surfaces, rollout = _page(session, config), _surfaces(config.repeats), session.rollout()
    files = [_file(rollout, name, config.repeats) for name in ("scene.usdc", "scene.ply", "scene.vtkhdf")]
    result = {"page": page, "surface": surfaces, "files": files}
    print(json.dumps(result, indent=1))
    if config.json is not None:
        write_json(config.json, {"meta": provenance("cpu"), **result})
    return 0


def _session(simulator: Simulator, particles: int) -> PlaySession:
    """The scene that hgn.play begins with, its water another block of so many particles."""
    path = find_scene("play")
    scene = load_scene(path)
    side = CELL * (particles / 8) ** (1 / 3)
    position_N3 = (0.3, 0.6, 0.5) + side * (np.random.default_rng(0).random((particles, 3)) - 0.5)
    water_N3 = position_N3.astype(np.float32)
    scene = replace(scene, position_N3=water_N3, velocity_N3=0 * water_N3, material_N=np.zeros(particles, np.uint8))
    return PlaySession(simulator, scene, path.parent)


def _page(session: PlaySession, config: ScreensConfig) -> dict[str, Any]:
    """Frames a second of a page that is looked at, in windows of one second."""
    page = PlayPage(session, port=0)
    if not config.browser:
        page.viewed.set()
    thread = threading.Thread(target=page.run)
    thread.start()
    rates = []
    try:
        with _browser(page.address) if config.browser else nullcontext():
            cpu, first = time.process_time(), session.frame
            for _ in range(config.seconds):
                begin, frame = time.monotonic(), session.frame
                time.sleep(1)
                rates.append((session.frame - frame) / (time.monotonic() - begin))
            cpu = time.process_time() - cpu
            frames, viewers = session.frame - first, len(page.server.get_clients())
    finally:
        page.ended.set()
        thread.join()
        page.close()
    return {
        "particles": config.particles,
        "weights": config.weights,
        "viewers": viewers,
        "frames": frames,
        "best_hz": max(rates),
        "median_hz": float(np.median(rates)),
        "cpu_ms": 1e3 * cpu / max(1, frames),
    }


@contextmanager
def _browser(address: str) -> Iterator[None]:
    """A headless browser that shows a page."""
    from playwright.sync_api import sync_playwright

    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=BROWSER)
        page = browser.new_page()
        page.set_default_timeout(300_000)
        page.goto(address)
        page.wait_for_function("/[1-9]\\d* frames a second/.test(document.body.innerText)")
        yield
        browser.close()


def _least(action: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Wall and CPU milliseconds of the fastest of some calls."""
    times = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        action()
        times.append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)))
    return {"ms": min(wall for wall, _ in times), "cpu_ms": min(cpu for _, cpu in times)}


def _surfaces(repeats: int) -> list[dict[str, Any]]:
    """A block of water at rest, as a lattice and as a random filling: the surface's volume against the particles'."""
    rows = []
    spacing = CELL / 2
    lattice_N3 = (np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * spacing
    random_N3 = np.random.default_rng(0).random((SIDE**3, 3)) * SIDE * spacing
    for name, position_N3 in (("lattice", lattice_N3), ("random filling", random_N3)):
        mesh = trimesh.Trimesh(*fluid_surface(position_N3, spacing), process=False)
        row = {"block": name, "particles": SIDE**3, "vertices": len(mesh.vertices), "closed": bool(mesh.is_watertight)}
        row["volume_error"] = float(mesh.volume / (SIDE * spacing) ** 3 - 1)
        rows.append(row | _least(partial(fluid_surface, position_N3, spacing), 4 * repeats))
    return rows


def _file(rollout: Rollout, name: str, repeats: int) -> dict[str, Any]:
    """Milliseconds and bytes a frame."""
    with tempfile.TemporaryDirectory() as folder:
        times = _least(lambda: save_rollout(Path(folder) / name, rollout), repeats)
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
    row = {"file": Path(name).suffix, "particles": rollout.particle_count, "frames": rollout.frame_count}
    per_frame = {key: value / rollout.frame_count for key, value in times.items()}
    return row | per_frame | {"bytes_a_frame": size / rollout.frame_count}


if __name__ == "__main__":
    run_command(main, "screens")
