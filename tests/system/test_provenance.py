"""Where a figure comes from, without the folders of the machine that it was made on."""

import subprocess
import sys

from hgn.system.provenance import without_folders


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


def test_the_command_is_told_whole():
    """A recorded command names its module and the part, and can be typed again but for the folders."""
    code = "import runpy, sys; sys.argv = ['x']; from hgn.system.provenance import command_line; print(command_line())"
    told = subprocess.run([sys.executable, "-c", code, "part", "out=/tmp/x.json"], capture_output=True, text=True)
    assert told.returncode == 0 and told.stdout.strip().endswith("part out=x.json") and "/" not in told.stdout
