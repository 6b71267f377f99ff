"""One tree's process of tools.compare, python -P server.py SETTINGS: checks, times and profiles kernels as it is told.

Orders and answers are lines of JSON. Started by path, with the tree's folder first on PYTHONPATH: hgn and tools.bench
are that tree's, so nothing else of tools.compare may be imported here, and of a tree no more than what trees have long
had.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import torch

import hgn
from hgn.config import NetworkConfig
from hgn.schema import from_mapping
from tools.bench import contenders, fast
from tools.bench.states import Workload, batch_of_scenes, state_of

BENCH_PRECISION = {setting: name for name, setting in fast.PATH_PRECISION.items()}
REFERENCE_SCENES = 8  # of an update at once in float64, so that they fit into a GPU
TURN_S, MOST_SAMPLES = 0.05, 6  # a turn has samples for so long, and so many at most
MOST_KERNELS = 24  # of a profile


class FrameCase:
    """A frame. Where it is too large for float64, one tile of it is checked by the same code, as the bench does."""

    def __init__(self, precision: str, network: NetworkConfig, work: Workload, device: torch.device) -> None:
        self.timed = self.checked = fast.FastFrame(precision, network, work, device)
        checked = contenders.checked_workload(work, "frame")
        if checked != work:
            self.checked = fast.FastFrame(precision, network, checked, device)

    def check(self, precision: str) -> str:
        if self.checked is not self.timed:
            self.timed.restore()
            self.timed.rollout.run(1)  # makes room where it needs more, as checks do
        return self.checked.check(precision)

    def sample(self) -> tuple[list[float], str | None]:
        return self.timed.timed().sample(), self.timed.failure


class UpdateCase:
    """A training update, all of whose scenes are checked."""

    def __init__(self, precision: str, network: NetworkConfig, work: Workload, device: torch.device) -> None:
        self.timed = fast.FastTrain(precision, network, work, device)

    def check(self, precision: str) -> str:
        return self.timed.check(precision)

    def sample(self) -> tuple[list[float], str | None]:
        return self.timed.timed().sample(), None


class Server:
    """Answers orders: each is a method, its arguments are the order's other keys, and it returns the answer's."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.network = from_mapping(NetworkConfig, settings["network"])
        self.precision = BENCH_PRECISION[settings["precision"]]
        self.particles: int = settings["particles"]
        self.references = Path(settings["references"])
        self.device = torch.device(settings["device"])
        self.gpu = self.device.type == "cuda"
        if self.gpu:
            torch.cuda.set_device(self.device.index or 0)
        torch.set_float32_matmul_precision(contenders.MATMUL[self.precision])
        self.cases: dict[str, FrameCase | UpdateCase] = {}
        self.expected: Any = None  # of the case that is checked
        self.errors: dict[str, float] = {}
        self._lend_references()

    def _lend_references(self) -> None:
        """The bench's own checks take float64's answers from here: one process makes them, for all trees."""

        def verdict(what: str, error: float, bound: float) -> str:
            self.errors[what] = float(error)
            return contenders.verdict(what, error, bound)

        lent: dict[str, Any] = {
            "reference_acceleration": lambda *_: self.expected,
            "reference_gradients": lambda *_: self.expected,
            "verdict": verdict,
        }
        if not self.gpu:  # nothing to hide launches behind
            lent |= {"FRAMES_AT_ONCE": 1, "UPDATES_AT_ONCE": 1}
        assert lent.keys() <= vars(fast).keys()
        vars(fast).update(lent)

    def hello(self) -> dict[str, Any]:
        """The folder that the sources come from."""
        return {"folder": str(Path(str(hgn.__path__[0])).resolve().parent)}

    def reference(self, case: str) -> dict[str, Any]:
        """Writes what the plain network gives in float64: accelerations, or loss and gradients of all scenes."""
        network = contenders.bench_network(self.network, self.device)
        kind, work = self._work(case)
        expected: Any
        if kind == "frame":
            state = state_of(contenders.checked_workload(work, "frame"), self.network, self.device)
            with torch.no_grad():
                expected = contenders.reference_acceleration(network, state)
        else:
            loss, gradient = torch.zeros(()), torch.zeros(())
            for first in range(0, work.scenes, REFERENCE_SCENES):
                scenes = [Workload(work.particles, 1)] * min(REFERENCE_SCENES, work.scenes - first)
                batch = batch_of_scenes(scenes, self.network, self.device, first)
                share = len(scenes) / work.scenes
                of_scenes = contenders.reference_gradients(network, batch)
                loss, gradient = loss + share * of_scenes[0].cpu(), gradient + share * of_scenes[1].cpu()
            expected = (loss, gradient)
        torch.save(expected, self.references / f"{case}.pt")
        self._free()
        return {}

    def prepare(self, case: str) -> dict[str, Any]:
        """Makes the tensors that a case works on."""
        kind, work = self._work(case)
        make = FrameCase if kind == "frame" else UpdateCase
        self.cases[case] = make(self.precision, self.network, work, self.device)
        return {}

    def check(self, case: str) -> dict[str, Any]:
        """The bench's verdict, and the relative errors that it is based on."""
        self.expected, self.errors = torch.load(self.references / f"{case}.pt", map_location=self.device), {}
        verdict = self.cases[case].check(self.precision)
        self.expected = None
        self._free()
        return {"check": verdict, "errors": self.errors}

    def sample(self, case: str) -> dict[str, Any]:
        """Milliseconds of a frame or an update, several times where it is short."""
        started = time.monotonic()
        found: list[float] = []
        while not found or (len(found) < MOST_SAMPLES and time.monotonic() - started < TURN_S):
            milliseconds, failure = self.cases[case].sample()
            if failure is not None:
                return {"error": failure}
            found += milliseconds
        return {"ms": found}

    def profile(self, case: str) -> dict[str, Any]:
        """Microseconds and launches of each kernel, of one frame or update; the longest, and all together."""
        from torch.profiler import ProfilerActivity, profile

        timed = self.cases[case].timed
        activity = ProfilerActivity.CUDA if self.gpu else ProfilerActivity.CPU
        with profile(activities=[activity], acc_events=True) as found:  # without it PyTorch 2.11 warns of more rounds
            timed.run()
            if self.gpu:
                torch.cuda.synchronize()
        at_once = int(timed.rollout.frame) if isinstance(timed, fast.FastFrame) else fast.UPDATES_AT_ONCE
        kernels = []
        for event in found.key_averages():
            total = event.self_device_time_total if self.gpu else event.self_cpu_time_total
            if total > 0:
                kernels.append({"kernel": event.key[:90], "us": total / at_once, "launches": event.count / at_once})
        kernels.sort(key=lambda kernel: -kernel["us"])
        whole = {name: sum(kernel[name] for kernel in kernels) for name in ("us", "launches")}
        return whole | {"kernels": kernels[:MOST_KERNELS]}

    def _work(self, case: str) -> tuple[str, Workload]:
        kind, _, count = case.partition("_")
        return kind, Workload(int(count), 1) if kind == "frame" else Workload(self.particles, int(count))

    def _free(self) -> None:
        gc.collect()
        if self.gpu:
            torch.cuda.empty_cache()


def serve(server: Server) -> None:
    """Reads orders until there are no more."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        order = json.loads(line)
        started = time.monotonic()
        answer: dict[str, Any]
        try:
            answer = getattr(server, order.pop("order"))(**order)
        except Exception as error:  # noqa: BLE001 - not swallowed: whoever asked tells of it, and no time is taken
            traceback.print_exc()
            answer = {"error": " ".join(f"{type(error).__name__}: {error}".split())[:400]}
        answers.write(json.dumps(answer | {"seconds": round(time.monotonic() - started, 2)}) + "\n")


if __name__ == "__main__":
    serve(Server(json.loads(sys.argv[1])))
