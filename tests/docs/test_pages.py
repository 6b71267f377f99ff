"""What holds of every Markdown page: width, links, paths; and of README and CHANGELOG, whose form is fixed."""

import ast
import dataclasses
import functools
import importlib.util
import re
import shlex

import pytest
from composition import compose
from docs.pages import ROOT, blocks_of, markdown_files, prose_lines, shell_lines
from hydra import initialize_config_dir

from hgn import config
from hgn.scene.scene_file import EmitterEntry, GroupEntry, ObstacleEntry, SceneFile

COLUMNS = 100
README_LINES, README_COMMANDS, ENTRY_LINES = 130, 12, 2
PAGES = markdown_files()
_PLACES = {page: page.relative_to(ROOT).parts for page in PAGES}
# README and docs/ but for the pages of what was: they keep the names of their day
OWN_PAGES = [page for page, place in _PLACES.items() if place[0] == "README.md"]
OWN_PAGES += [page for page, place in _PLACES.items() if place[0] == "docs" and place[1] not in ("log", "results")]
CODE = re.compile(r"`[^`]+`")
LINK = re.compile(r"!?\[(?:[^\]\\]|\\.)*\]\(([^)\s]+)\)")
ADDRESS = re.compile(r"\S*(?:https?://|s3://)\S*")
NAMES_IN = re.compile(r"((?:`[\w.]+`(?:, | and |,\n|\n)?)+)\s+in\s+`([\w/]+\.py)`")
TESTS_IN = re.compile(r"`(tests/[\w/]+\.py)`\s+\(((?:`\w+`(?:,\s+)?)+)\)")
# folders of the checkout whose names begin a path in prose
PATH = re.compile(r"`((?:hgn|datagen|tools|tests|conf|jobs|docs|results)/[\w./-]*\w/?)`")


@functools.cache
def anchors(page):
    """The anchors of a page's headings, as GitHub and MyST make them."""
    found: set[str] = set()
    for _, line in prose_lines(page):
        heading = re.match(r"#+ (.*)", line)
        if heading:
            text = re.sub(r"[^\w\- ]", "", heading[1].replace("`", "").lower())
            found.add(text.strip().replace(" ", "-"))
        found |= set(re.findall(r"^\(([\w-]+)\)=$", line))
    return found


def counted(line):
    """A line without what may be long: addresses, and the targets of links."""
    return ADDRESS.sub("", re.sub(r"\]\([^)]*\)", "]", line))


def leads_somewhere(page, target):
    """Whether a link's file and anchor are there; addresses of other hosts are."""
    name, _, anchor = target.partition("#")
    file = (page.parent / name).resolve() if name else page
    return re.match(r"[a-z0-9+]+:", target) or (file.exists() and (not anchor or anchor in anchors(file)))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_prose(page):
    """No line is wider than 100 columns (tables, addresses and blocks of code are left out), each link to a file of the
    project and to an anchor in it leads there, and each path of the checkout that README and docs/ name exists."""
    faults = []
    for number, line in prose_lines(page):
        wide = not line.startswith("|") and len(counted(line)) > COLUMNS
        links = [link for link in LINK.findall(CODE.sub("", line)) if not leads_somewhere(page, link)]
        paths = [path for path in PATH.findall(line) if page in OWN_PAGES and not (ROOT / path).exists()]
        faults += [f"line {number}: {fault}" for fault in ("wide",) * wide + (*links, *paths)]
    assert not faults


def test_figures_are_drawn():
    """Each figure that a results page places has a report beside it, and each figure that can be drawn is placed."""
    figures = extension("figures")
    placed = set()
    for page in PAGES:
        for match in figures.MARKER.finditer(page.read_text()):
            placed.add(str((page.parent / match["name"]).relative_to(ROOT)))
    assert placed == set(figures.FIGURES)
    assert all((ROOT / report).is_file() for report, _ in figures.FIGURES.values())


def extension(name):
    """A module of docs/_ext."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "_ext" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_names_exist():
    """Names that a page locates in a file exist there: "`NAME` in `FILE`", and names in brackets after a file of
    tests."""
    checked = 0
    for page in OWN_PAGES:
        text = "\n".join(line for _, line in prose_lines(page))
        pairs = [(name, file) for names, file in NAMES_IN.findall(text) for name in re.findall(r"`([\w.]+)`", names)]
        pairs += [(name, file) for file, names in TESTS_IN.findall(text) for name in re.findall(r"`(\w+)`", names)]
        for name, file in pairs:
            last = name.rpartition(".")[2]
            assert re.search(rf"\b{last}\b", (ROOT / file).read_text()), f"{page.relative_to(ROOT)}: {name} in {file}"
            checked += 1
    assert checked > 20
    for row in re.findall(r"^\| .*\| `hgn/kernels/.*\|$", (ROOT / "docs/backends.md").read_text(), re.MULTILINE):
        *_, kernels, folders, _ = row.split("|")
        files = [file for folder in re.findall(r"`([\w/]+)`", folders) for file in (ROOT / folder).glob("*.py")]
        sources = "".join(file.read_text() for file in files)
        assert all(f"def {name}(" in sources for name in re.findall(r"`(\w+)`", kernels)), row


def test_settings_exist():
    """Each setting that README and docs/ name by its group is a field of it."""
    names = ("scene", "mpm", "dataset", "network", "step", "training")
    groups, checked = {name: getattr(config, f"{name.title()}Config") for name in names}, 0
    for page in OWN_PAGES:
        for code in CODE.findall("\n".join(line for _, line in prose_lines(page))):
            for group, name in re.findall(r"(?<![\w./])(scene|mpm|dataset|network|step|training)\.([a-z]\w*)", code):
                if name not in ("py", "md", "yaml"):
                    fields = [field.name for field in dataclasses.fields(groups[group])]
                    assert name in fields, f"{page.relative_to(ROOT)}: {group}.{name}"
                    checked += 1
    assert checked > 20


def commands():
    """Each `python -m` line of README and docs/, in blocks and in code within lines, with the last place of it."""
    found = {}
    for page in OWN_PAGES:
        for block in blocks_of(page):
            lines = shell_lines(block) if block.language == "bash" else ()
            found |= {line: str(block) for line in lines if line.startswith("python -m ")}
        for number, line in prose_lines(page):
            found |= {text: f"{page.relative_to(ROOT)}:{number}" for text in re.findall(r"`(python -m [^`]+)`", line)}
    return found


def test_commands_compose():
    """Each command that a page shows is there, and each setting that it is given exists."""
    assert len(commands()) > 20
    for line, place in commands().items():
        _, _, module, *arguments = shlex.split(line.removesuffix("&").replace("…", "a"))
        assert importlib.util.find_spec(module) is not None, f"{place}: {line}"
        if module.split(".")[0] not in ("hgn", "datagen", "tools"):
            continue
        name = module.rpartition(".")[2]
        if module == "tools.stability" and arguments:
            name = f"stability_{arguments.pop(0)}"
        if not arguments or {"--help", "--config-dir"} & set(arguments):
            continue  # what is composed of a tutorial's own file, test_tutorials runs
        folder = ROOT / "conf" / ("command" if (ROOT / "conf" / "command" / f"{name}.yaml").is_file() else "")
        with initialize_config_dir(str(folder), version_base="1.3"):
            compose(folder, name, arguments)


def test_programs_parse():
    """Each Python block of README and docs/ parses, and has the names that it takes from the project."""
    checked = 0
    for block in (block for page in OWN_PAGES for block in blocks_of(page) if block.language == "python"):
        for line in ast.walk(ast.parse(block.content, str(block))):
            if isinstance(line, ast.ImportFrom) and str(line.module).split(".")[0] in ("hgn", "datagen", "tools"):
                module = importlib.import_module(str(line.module))
                assert all(hasattr(module, name.name) for name in line.names), f"{block}: {line.module}"
                checked += 1
    assert checked > 20


def test_readme_is_short():
    """At most 130 lines, none over 100 columns (tables too), and at most twelve commands in its table."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= README_LINES
    assert max(len(line) for line in lines) <= COLUMNS
    assert sum(line.startswith("| `python -m ") for line in lines) <= README_COMMANDS


def test_changelog_form():
    """Releases with Migration, Added, Changed, Removed and Fixed; entries of at most two lines."""
    lines = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()
    releases = [line for line in lines if line.startswith("## ")]
    assert releases[0] == "## Unreleased"
    assert all(re.fullmatch(r"## \d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)", line) for line in releases[1:])
    assert any(line.startswith("## 0.1.0 ") for line in releases)
    entry = 0
    for number, line in enumerate(lines, start=1):
        assert len(line) <= COLUMNS or line.startswith("| "), f"CHANGELOG.md:{number}"
        entry = 1 if line.startswith("- ") else entry + 1 if entry and line.startswith("  ") else 0
        assert entry <= ENTRY_LINES, f"CHANGELOG.md:{number}"
        if line.startswith("### "):
            assert re.match(r"### (Migration|Added|Changed|Removed|Fixed)", line), f"CHANGELOG.md:{number}"


def test_every_command_is_listed():
    """The reference of commands names each module that can be run, and no other."""
    reference_pages = extension("reference_pages")
    page = (ROOT / "docs" / "reference" / "commands.md").read_text()
    listed = set(re.findall(r"^\| `python -m ([\w.]+)", page, re.MULTILINE))
    parents = {name.removesuffix(".network") for name in reference_pages.command_names()}  # tools.stability network
    assert listed == parents

    text = reference_pages.configuration_page()
    for cls in (config.SceneConfig, config.MpmConfig, config.TrainingConfig, config.NetworkConfig):
        section = text.split(f"## {cls.__name__}\n")[1].split("\n## ")[0]
        assert re.findall(r"^\| `(\w+)`", section, re.MULTILINE) == [field.name for field in dataclasses.fields(cls)]
    assert "| `seed` | `NonNegative[int]` | `0` |" in text and "domain units per frame |" in text
    assert reference_pages.commands_page().count(f"| `weights` | `str` | `'{config.DEFAULT_WEIGHTS}'` |") == 4


def test_scene_files_are_described_whole():
    """The page on scene files has each field that the file and its entries may have, and each shape."""
    text = (ROOT / "docs" / "how_to" / "scene_files.md").read_text()
    rows = {cell for line in text.splitlines() if line.startswith("| `") for cell in CODE.findall(line.split("|")[1])}
    entries = (SceneFile, GroupEntry, EmitterEntry, ObstacleEntry)
    fields = {f"`{field.name}`" for entry in entries for field in dataclasses.fields(entry)}
    assert rows == fields | {f"`{shape}`" for shape in config.OBSTACLE_SHAPES}
