"""tools.curves: one run, several runs, a run that was stopped, and folders that are none."""

import json
import math
import os
from dataclasses import replace

import pytest
import yaml
from matplotlib.backends.backend_agg import RendererAgg
from PIL import Image

from hgn.schema import ConfigError, printable
from tools.curves import draw, main, read_run

SETTINGS = {
    "training": {"batch_scenes": 2},
    "dataset": {"folder": "data/obstacles"},
    "provenance": {"device": "a device", "commit": "abc", "date": "2026-01-01T00:00:00+00:00"},
}


def make_run(folder, updates=40, pause=0.0, repeated=0, error=1e-6, ranks=1):
    """A run that logs each second; `pause` seconds away after half of its updates, the last `repeated` then again."""
    folder.mkdir(parents=True)
    numbers = [*range(updates // 2), *range(updates // 2 - repeated, updates)]
    lines, now = [], 100.0
    for i, update in enumerate(numbers):
        now += 1 + (pause if i == updates // 2 else 0)
        rates = {"updates_per_second": 1.5, "scenes_per_second": 3.0 * ranks}
        lines.append({"update": update, "time": now, "loss": 1 / (i + 1), "episodes": 3} | rates)
        if update % 10 == 9:
            errors = {"one_step/validation": error / update, "baseline/validation_constant_velocity": 1e-5}
            lines.append({"update": update, "time": now, "rollout/mse_frame_10": 1e-4} | errors)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "config.yaml").write_text(yaml.safe_dump(SETTINGS))
    return folder


def test_several_runs(tmp_path):
    """Each run has a curve, a name and all its records; the scenes of an update count on all ranks."""
    runs = [str(make_run(tmp_path / "x", ranks=2)), str(make_run(tmp_path / "y", error=1e-7))]
    assert main({"runs": runs, "out": str(tmp_path / "curves")}) == 0
    first, second = json.loads((tmp_path / "curves.json").read_text())["runs"]
    assert (first["name"], second["name"], first["meta"]["device"]) == ("x", "y", "a device")
    assert [(run["rows"][-1]["update"], run["rows"][-1]["scenes"]) for run in (first, second)] == [
        (39, 39 * 4), (39, 39 * 2)
    ]  # fmt: skip
    assert [row["update"] for row in first["rows"] if "loss" in row] == list(range(40))
    errors = [row["one_step/validation"] for row in first["rows"] if "one_step/validation" in row]
    assert errors == [1e-6 / update for update in (9, 19, 29, 39)]
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width > 1000 and picture.height > 300
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 24)}
    assert {(31, 119, 180), (255, 127, 14)} <= colours  # both lines are drawn


def test_short_runs(tmp_path, monkeypatch):
    """The files of a run are in its folder by default. An axis of less than two decades is linear, because the
    labels between two powers of ten overlap."""
    assert main({"runs": [str(make_run(tmp_path / "x"))]}) == 0
    assert {path.name for path in (tmp_path / "x").glob("curves.*")} == {"curves.png", "curves.json"}
    figures = []
    monkeypatch.setattr("tools.report.as_png", lambda figure: figures.append(figure) or b"")
    draw([read_run(make_run(tmp_path / name, updates=120)) for name in ("y", "z")])
    assert [panel.get_xscale() for panel in figures[0].axes] == ["log", "linear", "linear"]


def test_time_of_a_stop_does_not_count(tmp_path):
    """A resumed run has each update once, without the time of the stop."""
    records = read_run(make_run(tmp_path / "run", pause=5000, repeated=3)).records
    assert [record["update"] for record in records if "loss" in record] == list(range(40))
    assert records[-1]["minutes"] * 60 == pytest.approx(42)  # 43 lines, a second apart; the repeated ones took time too


def test_a_folder_that_is_no_run(tmp_path):
    """The error names the folder."""
    with pytest.raises(ConfigError, match=r"runs must be folders of python -m hgn.train, got .*empty"):
        read_run(tmp_path / "empty")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        *(("metrics.jsonl", text) for text in ("x", "[]", "{", "5", '{"loss": 1}', '{"update": [1], "time": 1}')),
        *(("metrics.jsonl", f'{{"update": 1, "time": 1, "loss": {text}}}') for text in ('"x"', "null", "[1]")),
        *(("metrics.jsonl", f'{{"update": {update}, "time": 1}}') for update in (10**400, 1e308, -1e308)),
        *(("metrics.jsonl", f'{{"update": 1, "time": 1, "loss": {loss}}}') for loss in (10**400, 1e308)),
        ("metrics.jsonl", '{"update": 1, "time": 1, "updates_per_second": 1e-300, "scenes_per_second": 1e308}'),
        *(("config.yaml", text) for text in ("[", "[]", "a: 1", "training:", "!!python/name:os.system", "[" * 5000)),
        ("config.yaml", yaml.safe_dump(SETTINGS | {"provenance": [1]})),
        ("config.yaml", yaml.safe_dump(SETTINGS) + "day: 2026-01-01\n"),
        ("config.yaml", "a: &a [1, 1]\n" + "".join(f"b{i}: &a [{','.join(9 * ['*a'])}]\n" for i in range(9))),
    ],
)
def test_damaged_runs(tmp_path, name, text):
    """One line names the folder."""
    make_run(tmp_path / "run")
    (tmp_path / "run" / name).write_text(text)
    with pytest.raises(ConfigError, match=r"run: runs must be folders of .*, got|must be a (number of|YAML file)"):
        main({"runs": [str(tmp_path / "run")], "out": str(tmp_path / "curves")})


@pytest.mark.parametrize("name", ["metrics.jsonl", "config.yaml"])
def test_pipes_are_refused(tmp_path, name):
    """Reading a pipe would wait for ever."""
    file = make_run(tmp_path / "run") / name
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(ConfigError, match=rf"run: runs must be folders of .*, got no plain file .*{name}"):
        read_run(tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "episodes"),
    [(r"$\frac{$", 1), (r"\$\frac$ $", 3), ("\ud800", math.nan), ("a\0", math.inf), ("$a$", 1)],
)
def test_odd_texts_and_counts_are_drawn(tmp_path, monkeypatch, name, episodes):
    """Names with dollar signs are no formulas. The picture of a number of episodes that is none exists too."""
    drawn = set()
    draw_text = RendererAgg.draw_text
    monkeypatch.setattr(
        RendererAgg, "draw_text", lambda self, *given, **more: (drawn.add(given[3]), draw_text(self, *given, **more))
    )
    run = read_run(make_run(tmp_path / "run"))
    one = {"training": run.settings["training"] | {"batch_scenes": 1}}
    odd = replace(run, name=name, settings=run.settings | {"dataset": {"folder": name}} | one)
    odd.records[-1]["episodes"] = episodes
    shown = printable(name)
    draw([odd])
    title = f"{shown}, {episodes} training episode{'s' * (episodes != 1)}, 1 scene an update, "
    assert any(text.startswith(title) for text in drawn)
    draw([odd, run])
    assert shown in drawn
