"""`python tests/viewer/soak.py SECONDS FILE.json`: two viewers of hgn.play drag, pour, turn, upload and reconnect.

The page runs in a process of its own; the viewers speak its websocket's protocol. Writes the memory of the page's
process every five seconds, and what it printed that looks like an error. Linux only.
"""

import asyncio
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import trimesh
import viser
import zstandard
from viser import _messages as messages
from websockets.asyncio.client import connect

from hgn.system.provenance import provenance

ROOT = Path(__file__).parents[2]
OPTIONS = ("browser=false", "port=0", "device=cpu", "particles=3000", "keep_mb=16")
WARM_S, EVERY_S, PART_BYTES = 60.0, 5.0, 1 << 19
NAMES = ("a.obj", "<img src=x onerror=alert(1)>.obj", "\x1b[31mb.obj", "c\0.obj", "../../d.obj", "e.txt")


@dataclass
class Viewer:
    """Represents a viewer: the messages that the page has sent to it, and those that it sends."""

    random: random.Random
    controls: dict[str, str] = field(default_factory=dict)  # labels and uuids
    obstacles: set[str] = field(default_factory=set)
    paused: bool = False
    frames: int = 0
    sent: int = 0
    answers: int = 0  # notifications

    async def act(self, address, until):
        """Connects, acts for a while and leaves, until the time is over."""
        while time.monotonic() < until:
            async with self.connected(address):
                leave = min(until, time.monotonic() + self.random.uniform(20, 60))
                while time.monotonic() < leave:
                    if self.paused:
                        await self.press("Pause")  # which goes on
                    await self.random.choice((self.drag, self.drag, self.turn, self.pour, self.drop, self.upload,
                                              self.upload, self.press, self.set_gravity))()  # fmt: skip

    @asynccontextmanager
    async def connected(self, address):
        """Listens, after it has told of its camera."""
        url, protocol = address.replace("http", "ws"), f"viser-v{viser.__version__}"
        async with connect(url, subprotocols=[protocol], max_size=None, compression=None) as self.socket:
            listening = asyncio.create_task(self.listen())
            await self.send(messages.ViewerCameraMessage(
                (1.0, 0.0, 0.0, 0.0), (0.5, 0.9, 2.0), 1.0, 0.01, 100.0, 600, 900, (0.5, 0.4, 0.5), (0.0, 1.0, 0.0)
            ))  # fmt: skip
            yield
            listening.cancel()

    async def send(self, message):
        self.sent += 1
        await self.socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    async def listen(self):
        async for data in self.socket:
            size = int.from_bytes(data[8:16], "little")
            content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
            for message in content["messages"]:
                kind, name = message["type"], str(message.get("name", ""))
                if kind.startswith("Gui") and "props" in message:
                    self.controls[message["props"].get("label", "")] = message["uuid"]
                elif kind == "GuiUpdateMessage" and "label" in message["updates"]:
                    self.paused = message["updates"]["label"] == "Play"
                elif kind == "RemoveSceneNodeMessage":
                    self.obstacles.discard(name)
                elif name.startswith("/obstacles/"):
                    self.obstacles.add(name)
                elif name.startswith("/particles/"):
                    self.frames += 1
                elif kind == "NotificationShowMessage":
                    self.answers += 1

    async def drag(self, modifier=None, name=None):
        name = name or self.random.choice(sorted(self.obstacles) or ["/obstacles/none"])
        begin = [self.random.uniform(0.1, 0.9) for _ in range(3)]
        for step, phase in enumerate(["start", *["update"] * 8, "end"]):
            end = [value + 0.02 * step * self.random.uniform(-1, 1) for value in begin]
            await self.send(messages.SceneNodeDragMessage(
                phase, name, None, tuple(begin), (0.5, 0.5), tuple(end), (0.5 + 0.02 * step, 0.5), "left", modifier
            ))  # fmt: skip
            await asyncio.sleep(0.05)

    async def turn(self):
        await self.drag("cmd/ctrl")

    async def pour(self):
        await self.drag("shift", "/room")

    async def drop(self):
        direction = (self.random.uniform(-0.3, 0.3), -0.5, -1.0)
        await self.send(messages.ScenePointerMessage("click", (0.5, 0.9, 2.0), direction, ((0.5, 0.5),), "shift"))
        await asyncio.sleep(0.2)

    async def upload(self):
        """A sphere of up to 2 MB or what is none, and room for the next."""
        mesh = trimesh.creation.icosphere(self.random.choice((2, 4, 6))).export(file_type="obj").encode()
        content = self.random.choice((mesh, mesh, mesh, b"no mesh", b""))
        parts = [content[start : start + PART_BYTES] for start in range(0, len(content), PART_BYTES)]
        transfer, button = f"{self.random.random()}", self.controls.get("Own mesh", "")
        name = self.random.choice(NAMES)
        await self.send(messages.FileTransferStartUpload(button, transfer, name, "", len(parts), len(content)))
        for index, part in enumerate(parts):
            await self.send(messages.FileTransferPart(button, transfer, index, part))
        await asyncio.sleep(0.2)
        if len(self.obstacles) > 4:
            await self.press("Remove the chosen")

    async def press(self, name=None):
        choice = ("Step", "Restart", "Add", "Remove the chosen", "Scene (YAML, zip)", "Back by", "Weights")
        name = name or self.random.choice(choice)
        value = {"Back by": "a frame", "Weights": self.random.choice(("obstacles_small", "/etc/passwd"))}
        message = messages.GuiUpdateMessage(self.controls.get(name, ""), {"value": value.get(name, True)})
        await self.send(message)
        await asyncio.sleep(0.2)

    async def set_gravity(self):
        value = (0.0, self.random.choice((-9.8, -9.8, -5.0, 1e30)), 0.0)
        await self.send(messages.GuiUpdateMessage(self.controls.get("Gravity", ""), {"value": value}))
        await asyncio.sleep(0.1)


def memory_mb(process):
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
    return int(lines["VmRSS"].split()[0]) / 1e3


async def soak(page, address, seconds):
    """The rows of the report."""
    viewers = [Viewer(random.Random(seed)) for seed in range(2)]
    start = time.monotonic()
    acting = [asyncio.create_task(viewer.act(address, start + seconds)) for viewer in viewers]
    rows = []
    while not all(task.done() for task in acting):
        await asyncio.wait(acting, timeout=max(0.0, start + (len(rows) + 1) * EVERY_S - time.monotonic()))
        row = {"s": time.monotonic() - start, "memory_mb": memory_mb(page.pid)}
        rows.append(row | {name: sum(getattr(v, name) for v in viewers) for name in ("frames", "sent", "answers")})
    await asyncio.gather(*acting)
    return rows


def main(seconds, file):
    with tempfile.TemporaryFile("w+") as errors:
        command = [sys.executable, "-m", "hgn.play", *OPTIONS]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        page = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            rows = asyncio.run(soak(page, page.stdout.readline().strip(), seconds))
            ended = page.poll()
        finally:
            page.terminate()
            page.wait()
        errors.seek(0)
        text = errors.read()
    warm = [row["memory_mb"] for row in rows if row["s"] >= min(WARM_S, seconds / 2)]
    report = {
        "meta": provenance() | {"config": {"seconds": seconds, "viewers": 2, "options": OPTIONS}},
        "ended": ended,  # the page's exit code; null: it went on to the end
        "growth_mb": max(warm) - warm[0],  # from a minute on
        "errors": text.count("Traceback"),
        "rows": rows,
    }
    Path(file).write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps({name: value for name, value in report.items() if name not in ("meta", "rows")}), rows[-1])
    return text


if __name__ == "__main__":
    print(main(float(sys.argv[1]), sys.argv[2])[-20000:])
