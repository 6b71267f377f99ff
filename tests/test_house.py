"""Limits on the size and the shape of the code. Each limit may be lowered, never raised without a reason in the commit.

The lists of exceptions name what is over a limit today. An entry leaves its list when the code is mended.
"""

import ast
import functools
import re
import subprocess
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("hgn", "datagen", "tools")

LINES = {  # of Python, in tracked files
    "hgn": 35_626,
    "datagen": 8_922,
    "tools": 6_278,
    "tests": 37_578,
}
SETTINGS = 235  # fields of the dataclasses behind the commands, *Config

LINES_OF_A_FILE = 450
LONG_FILES: dict[str, int] = {}

NARROW_PACKAGES = ("hgn/training/", "hgn/runtime/")
PARAMETERS, POSITIONAL_ARGUMENTS = 8, 4
MANY_PARAMETERS: dict[str, int] = {}
MANY_POSITIONAL_ARGUMENTS: dict[str, int] = {}

HEADLESS = re.compile(r"(What|Of|Whether|That|Those|These|How|Which|Whose|Where)\b")
HEADLESS_DOCSTRINGS = {"hgn": 0, "datagen": 0, "tools": 0}

UNCOMMENTED: set[str] = set()
UNMENTIONED: set[str] = set()

BYTES_OF_A_FILE = 500_000
LARGE_FILES = {  # shipped weights, and results that pages show
    "hgn/weights/mechanics.safetensors",
    "hgn/weights/obstacles_small.safetensors",
    "hgn/weights/own_physics.safetensors",
    "results/stability/network_h100.json",
    "results/stability/own_scenes.webp",
    "results/stability/thrown.webp",
}


@functools.cache
def tracked(*patterns: str) -> tuple[str, ...]:
    """Names of the tracked files that exist, relative to the root."""
    if not (ROOT / ".git").exists():
        pytest.skip("needs a checkout")
    command = ["git", "-C", str(ROOT), "ls-files", "-z", *patterns]
    names = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\0")
    return tuple(name for name in dict.fromkeys(names) if name and (ROOT / name).is_file())


@functools.cache
def line_counts() -> dict[str, int]:
    return {name: (ROOT / name).read_bytes().count(b"\n") for name in tracked("*.py")}


@functools.cache
def tree(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_bytes())


def in_packages(*folders: str) -> list[str]:
    return [name for name in tracked("*.py") if name.startswith(folders)]


@functools.cache
def settings() -> dict[str, tuple[str, ast.AnnAssign]]:
    """File and definition of each setting, by `Class.field`."""
    result = {}
    for name in in_packages(*(f"{package}/" for package in PACKAGES)):
        if re.search(rb"^class \w+Config\b", (ROOT / name).read_bytes(), re.MULTILINE) is None:
            continue
        classes = [node for node in tree(name).body if isinstance(node, ast.ClassDef)]
        for owner in (node for node in classes if node.name.endswith("Config")):
            for field in owner.body:
                if isinstance(field, ast.AnnAssign):
                    result[f"{owner.name}.{ast.unparse(field.target)}"] = (name, field)
    return result


def is_section(field: ast.AnnAssign) -> bool:
    """Whether a field holds another dataclass of settings."""
    return "Config" in ast.unparse(field.annotation)


@functools.cache
def comments(name: str) -> dict[int, str]:
    """The comment on each line of a file."""
    with (ROOT / name).open("rb") as file:
        tokens = list(tokenize.tokenize(file.readline))
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def comment_of(name: str, field: ast.AnnAssign) -> str:
    """The comment above a field and beside it."""
    texts = comments(name)
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    first = field.lineno
    while lines[first - 2].strip().startswith("#"):
        first -= 1
    found = [texts[line] for line in range(first, (field.end_lineno or field.lineno) + 1) if line in texts]
    return " ".join(found)


def over(counts: dict[str, int], limit: int, exceptions: dict[str, int]) -> dict[str, int]:
    """The entries that exceed the limit, or their own number among the exceptions."""
    return {name: count for name, count in counts.items() if count > max(limit, exceptions.get(name, 0))}


def test_lines_of_packages():
    """Each package stays within its number of lines."""
    totals = {package: sum(line_counts()[name] for name in in_packages(f"{package}/")) for package in LINES}
    assert over(totals, 0, LINES) == {}


def test_lines_of_files():
    """No file has more than 450 lines."""
    counts = {name: line_counts()[name] for name in in_packages(*(f"{package}/" for package in LINES))}
    assert over(counts, LINES_OF_A_FILE, LONG_FILES) == {}


def test_number_of_settings():
    """Commands have no more settings than today."""
    assert len(settings()) <= SETTINGS


def test_settings_are_explained():
    """Each setting has a comment that stands alone, and a config, a launch file or a page names it."""
    fields = {key: value for key, value in settings().items() if not is_section(value[1])}
    uncommented = {key for key, (name, field) in fields.items() if comment_of(name, field).strip(" …") == ""}
    assert uncommented <= UNCOMMENTED, "write a comment above or beside the field"
    pages = [name for name in tracked("conf", "jobs", "docs/*.md", "README.md", "Makefile") if "docs/log/" not in name]
    words = {word for name in pages for word in re.findall(rb"\w+", (ROOT / name).read_bytes())}
    unmentioned = {key for key in fields if key.partition(".")[2].encode() not in words}
    assert unmentioned <= UNMENTIONED, "fix the setting to its value, or tell users what it is for"


def test_narrow_signatures():
    """Functions of the training and the runtime take at most eight arguments."""
    counts: dict[str, int] = {}
    for name in in_packages(*NARROW_PACKAGES):
        for node in ast.walk(tree(name)):
            if isinstance(node, ast.FunctionDef):
                given = node.args
                names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
                count = len(names) - (names[:1] in (["self"], ["cls"]))
                counts[f"{name}:{node.name}"] = max(count, counts.get(f"{name}:{node.name}", 0))
    assert over(counts, PARAMETERS, MANY_PARAMETERS) == {}


def test_named_arguments():
    """Calls in the training and the runtime pass at most four arguments by position."""
    counts = dict.fromkeys(in_packages(*NARROW_PACKAGES), 0)
    for name in counts:
        calls = (node for node in ast.walk(tree(name)) if isinstance(node, ast.Call))
        counts[name] = sum(len(call.args) > POSITIONAL_ARGUMENTS for call in calls)
    assert over(counts, 0, MANY_POSITIONAL_ARGUMENTS) == {}


def test_docstrings_start_with_a_verb():
    """Docstrings of functions and classes say what is returned, done or contained, as in "Returns the time step"."""
    counts = dict.fromkeys(PACKAGES, 0)
    for package in PACKAGES:
        for name in in_packages(f"{package}/"):
            if re.search("[\"']" + HEADLESS.pattern, (ROOT / name).read_text(encoding="utf-8")) is None:
                continue  # parsing takes a hundred times as long
            nodes = (node for node in ast.walk(tree(name)) if isinstance(node, (ast.FunctionDef, ast.ClassDef)))
            texts = (ast.get_docstring(node, clean=False) or "" for node in nodes)
            counts[package] += sum(HEADLESS.match(text) is not None for text in texts)
    assert over(counts, 0, HEADLESS_DOCSTRINGS) == {}


def test_large_files():
    """No tracked file exceeds 500 kB, except the listed weights and results."""
    large = {name for name in tracked() if (ROOT / name).stat().st_size > BYTES_OF_A_FILE}
    assert large <= LARGE_FILES, "draw it from its data, keep it out of the repository, or list it here"


def test_conflicts_are_resolved():
    """No tracked text file has a line that git writes where a merge failed."""
    marks = re.compile(r"^(<<<<<<<|>>>>>>>) ", re.MULTILINE)
    names = tracked("*.md", "*.py", "*.yaml", "*.toml", "*.c", "Makefile")
    assert [name for name in names if marks.search((ROOT / name).read_text(encoding="utf-8"))] == []
