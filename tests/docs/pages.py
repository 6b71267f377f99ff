"""The Markdown pages of the project: their fenced blocks, prose lines and links, and a runner for the blocks."""

import os
import re
import runpy
import shlex
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("conf", "datagen", "docs", "hgn", "jobs", "results", "tests", "tools")
_FENCE = re.compile(r"^( *)(`{3,})([^`\n]*)$")
_FILE_MARK = re.compile(r"<!-- file: (\S+) -->")


@dataclass(frozen=True)
class Block:
    """A fenced block; `file` is the name that a comment `<!-- file: NAME -->` before it gives."""

    page: str
    line: int
    language: str
    content: str
    file: str | None

    def __str__(self):
        return f"{self.page}:{self.line}"


def markdown_files():
    """All Markdown files that are part of the project."""
    found = [*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))]
    made = {"_build", "_generated"}
    return sorted(page for page in found if not made & set(page.relative_to(ROOT).parts))


def blocks_of(page):
    """The fenced blocks of a page, in order."""
    blocks: list[Block] = []
    opened: tuple[int, str, str, str | None] | None = None
    content: list[str] = []
    file: str | None = None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        fence = _FENCE.match(line)
        if opened is None and fence is not None:
            opened, content = (number, fence[2], fence[3].strip(), file), []
        elif opened is not None and fence is not None and fence[2] == opened[1] and not fence[3]:
            text = "".join(f"{item}\n" for item in content)
            blocks.append(Block(str(page.relative_to(ROOT)), opened[0], opened[2], text, opened[3]))
            opened = file = None
        elif opened is not None:
            content.append(line)
        elif line.strip():
            mark = _FILE_MARK.fullmatch(line.strip())
            file = mark[1] if mark else None
    assert opened is None, f"{page}: a fence opened in line {opened and opened[0]} is not closed"
    return blocks


def prose_lines(page):
    """Number and text of the lines outside fenced blocks."""
    fence = ""
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        found = _FENCE.match(line)
        if found is not None and not fence:
            fence = found[2]
        elif found is not None and found[2] == fence and not found[3]:
            fence = ""
        elif not fence:
            yield number, line


def shell_lines(block):
    """The commands of a shell block, continued lines joined, comments left out."""
    lines = block.content.replace("\\\n", " ").splitlines()
    bare = [re.sub(r"(^|\s)#.*", "", line).strip() for line in lines]
    return [line for line in bare if line]


def make_targets():
    """What `make` can be asked for."""
    return set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@dataclass
class Runner:
    """Runs the blocks of a page in order in the current folder, as they stand there.

    `settings` are appended to a command's own, by module, so that it is done in seconds; `smaller` replaces text of
    Python blocks, each of which must occur. Commands that another test stands for are in `elsewhere`, with the reason.
    """

    settings: Mapping[str, Sequence[str]]
    smaller: Mapping[str, str] = field(default_factory=dict)
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    setenv: Callable[[str, str], None] | None = None  # for `export NAME=VALUE`
    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__main__"})
    background: list[subprocess.Popen[str]] = field(default_factory=list)
    ran: list[str] = field(default_factory=list)

    def run(self, page):
        """Runs every block; a language that it does not know is an error."""
        replaced: set[str] = set()
        for block in blocks_of(page):
            self._write(block)
            if block.language == "text":  # what a command prints, or a file
                continue
            if block.language == "bash":
                for line in shell_lines(block):
                    self._shell(line, block)
            elif block.language == "python":
                code = block.content
                for text, other in self.smaller.items():
                    if text in code:
                        code, replaced = code.replace(text, other), replaced | {text}
                exec(compile(code, str(block), "exec"), self.names)
                self.ran.append(str(block))
            else:
                assert block.language == "yaml" and block.file is not None, f"{block}: {block.language} is not run"
        assert replaced == set(self.smaller), set(self.smaller) - replaced

    @staticmethod
    def _write(block):
        if block.file is not None:
            Path(block.file).parent.mkdir(parents=True, exist_ok=True)
            Path(block.file).write_text(block.content, encoding="utf-8")

    def _shell(self, line, block):
        self.ran.append(line)
        if line in self.elsewhere:
            return
        words = shlex.split(line)
        if words[0] == "make":
            assert words[1] in make_targets(), f"{block}: {line}"
            return
        if words[0] == "export":
            assert self.setenv is not None, f"{block}: {line}"
            self.setenv(*words[1].split("=", 1))
            return
        assert words[:2] == ["python", "-m"], f"{block}: {line}"
        background = words[-1] == "&"
        arguments = [*words[3 : len(words) - background], *self.settings.get(words[2], ())]
        if background:
            command = [sys.executable, "-m", words[2], *arguments]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path.cwd(), env=_environment())
            self.background.append(process)
            assert process.stdout is not None
            assert any("serving" in text for text in process.stdout), f"{block}: {line}"
        else:
            assert run_module(words[2], arguments) == 0, f"{block}: {line}"


def _environment():
    return dict(os.environ, PYTHONPATH=os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))


def run_module(module, arguments):
    """`python -m MODULE ARGUMENTS` in this process; returns the exit code."""
    before = sys.argv
    sys.argv = [module, *arguments]
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*found in sys.modules", category=RuntimeWarning)
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv = before
    return 0
