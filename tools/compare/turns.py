"""The course of a comparison: kernels compiled, checks, times in turns, profiles, checks again."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from hgn.system.machine import available_cpus
from tools.compare.children import Child, Children
from tools.compare.config import CompareConfig
from tools.compare.report import Report
from tools.compare.trees import Tree

LEAST_ROUNDS = 3
COMPILE_SHARE, LAST_SHARE = 0.45, 1 / 6  # of all seconds: at most for compiling; kept for profiles and last checks


class Comparison:
    """Asks the children, and tells the report; `passing` are the trees of a case with green checks so far."""

    def __init__(self, config: CompareConfig, children: Children, trees: Sequence[Tree], report: Report) -> None:
        self.config, self.children, self.report = config, children, report
        self.interpreted = children.interpreter
        self.begun = time.monotonic()
        self.trees = trees
        self.servers = [children.serve(tree) for tree in trees]
        self.passing: dict[str, list[Child]] = {}

    def run(self) -> None:
        """All of it. What is found is written after each step."""
        self.report.write()
        self._begin()
        for case in self.config.cases:
            self._prepare(case)
        self._take_turns()
        for case in self.config.profiled:
            self._profile(case)
        for case in self.config.cases:
            self._check(case, "after")
        self._say("done")

    def _begin(self) -> None:
        """Compiles while the first tree's process makes float64's answers, and sees that each has its own sources."""
        for case in self.config.cases:
            self.servers[0].tell("reference", case=case)  # the plain network, which launches no kernel of ours
        if not self.interpreted:
            shares = max(1, (available_cpus() - 2) // len(self.trees))
            enough = (1 - COMPILE_SHARE) * self.config.seconds
            self._say(self.children.compile(self.trees, shares, lambda: self._left() < enough))
        for case in self.config.cases:
            answer = self.servers[0].answer(self._left())
            if "error" in answer:
                self._say(f"float64 of {case}: {answer['error']}")
        for server in self.servers:
            answer = server.ask("hello", self._left())
            if "error" not in answer and answer["folder"] != str(server.tree.folder):
                raise RuntimeError(f"{server.tree.name} imports hgn from {answer['folder']}, not {server.tree.folder}")
        self._say("float64's answers are there")

    def _prepare(self, case: str) -> None:
        for server in self.servers:
            server.tell("prepare", case=case)
        ready = []
        for server in self.servers:
            answer = server.answer(self._left())
            if "error" in answer:
                self._check_failed(case, server, "before", answer)
            else:
                ready.append(server)
        self.passing[case] = ready
        self._check(case, "before")
        if not self.interpreted:
            self._sample(case, self.passing[case], kept=False)  # captures graphs, warms up

    def _check(self, case: str, when: str) -> None:
        """Checks the trees that pass so far, at once; who fails now passes no longer."""
        servers = list(self.passing[case])
        for server in servers:
            server.tell("check", case=case)
        for server in servers:
            answer = server.answer(self._left())
            if not self.report.add_check(case, server.tree.name, when, answer):
                self.passing[case].remove(server)
            errors = ", ".join(f"{name} {error:.1e}" for name, error in answer.get("errors", {}).items())
            verdict = answer.get("error") or answer["check"]
            self._say(f"{case} of {server.tree.name} {when}: {verdict}" + (f" ({errors})" if errors else ""))
        self.report.write()

    def _take_turns(self) -> None:
        for number in range(self.config.rounds):
            if number >= LEAST_ROUNDS and self._left() < LAST_SHARE * self.config.seconds:
                self._say(f"ended after {number} rounds, for lack of time")
                break
            for case in self.config.cases:
                turn = list(self.passing[case])
                self._sample(case, turn if number % 2 == 0 else turn[::-1], kept=True)
            self.report.write()
        else:
            self._say("times are taken")

    def _sample(self, case: str, servers: Sequence[Child], kept: bool) -> None:
        for server in list(servers):
            answer = server.ask("sample", self._left(), case=case)
            if "error" in answer:
                self.passing[case].remove(server)
                self._check_failed(case, server, "timing", answer)
            elif kept:
                self.report.add_times(case, server.tree.name, answer["ms"])

    def _profile(self, case: str) -> None:
        for server in self.passing[case]:
            answer = server.ask("profile", self._left(), case=case)
            if "error" in answer:
                self._say(f"profile of {case} of {server.tree.name}: {answer['error']}")
            else:
                self.report.add_profile(case, server.tree.name, answer)
        self.report.write()

    def _check_failed(self, case: str, server: Child, when: str, answer: dict[str, str]) -> None:
        self.report.add_check(case, server.tree.name, when, answer)
        self._say(f"{case} of {server.tree.name}, {when}: {answer['error']}")

    def _left(self) -> float:
        return self.config.seconds - (time.monotonic() - self.begun)

    def _say(self, text: str) -> None:
        print(f"{time.monotonic() - self.begun:6.1f} s  {text}", file=sys.stderr, flush=True)
