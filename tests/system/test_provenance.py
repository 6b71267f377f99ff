"""Where a figure comes from, without the folders of the machine that it was made on."""

from dataclasses import dataclass

from hgn.config import DatasetConfig, TrainConfig
from hgn.system.provenance import command_line, without_folders
from hgn.training.session import settings_of_run
from tools.report import meta_of


def test_folders_are_left_out():
    """Of absolute paths the last part stays, wherever they stand in a text; relative ones, URLs and fractions stay."""
    cases = {
        "/any/out/a.json": "a.json",
        "json=/tmp/a/b.json": "json=b.json",
        "weights=[/a/b.safetensors,/c/d.safetensors]": "weights=[b.safetensors,d.safetensors]",
        "--picture=/tmp/x/": "--picture=x",
        "/usr/bin/python3": "python3",
    }
    for text, expected in cases.items():
        assert without_folders(text) == expected
    stay = ("results/solver/a.json", "http://host:80/a/b", "s3://bucket/a", "1/2", "conf/a", "../a/b", "/", "a = b")
    for text in stay:
        assert without_folders(text) == text
    nested = {"a": ["/x/y", 3, None], "b": {"c": ("/x/z",)}}
    assert without_folders(nested) == {"a": ["y", 3, None], "b": {"c": ["z"]}}


def test_no_record_of_settings_has_a_secret():
    """Reports, and the config.yaml of a run, keep settings without passwords of URLs and values of secret keys."""

    @dataclass
    class Settings:
        data: str = "http://user:secret-word@host/set"
        more: tuple[str, ...] = ("s3://key:secret-word@b", "HF_TOKEN=secret-word")

    config = meta_of(Settings())["config"]
    assert config == {"data": "http://host/set", "more": ["s3://b", "HF_TOKEN=…"]}
    run = settings_of_run(TrainConfig(run="HF_TOKEN=secret-word", dataset=DatasetConfig(folder=Settings.data)))
    assert "secret-word" not in str(run) and run["dataset"]["folder"] == "http://host/set"


def test_the_recorded_command(monkeypatch):
    """A recorded command names its module and its arguments, and can be typed again except for the folders."""
    given = ["/usr/bin/python", "-m", "tools.stability", "part", "out=/any/x.json"]
    monkeypatch.setattr("sys.orig_argv", given)
    assert command_line() == "python -m tools.stability part out=x.json"
    monkeypatch.setattr("sys.orig_argv", [*given, "a.token=it's mine", "env=HF_TOKEN=x b"])
    assert command_line() == "python -m tools.stability part out=x.json 'a.token=…' 'env=HF_TOKEN=…'"
