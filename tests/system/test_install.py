"""The installation of `make setup` and `make demo`, with stand-ins for uv and pip."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PIP = """#!/bin/sh
case "$*" in *"config list"*) ;; *) echo "retries $PIP_RETRIES" ;; esac
"""


@pytest.mark.parametrize(("chosen", "retries"), [({}, "2"), ({"PIP_RETRIES": "7"}, "7")])
def test_pip_does_not_wait_long_for_an_index_that_uv_cannot_reach(tmp_path, chosen, retries):
    """After uv, pip retries twice a package, or as often as chosen, and one line names the remedy."""
    if not (install := ROOT / ".ci" / "install").exists():
        pytest.skip("needs a checkout")
    (tmp_path / "bin").mkdir()
    for name, script in {"python": PIP, "uv": "#!/bin/sh\nexit 2\n"}.items():
        (tmp_path / "bin" / name).write_text(script)
        (tmp_path / "bin" / name).chmod(0o755)
    environment = {key: value for key, value in os.environ.items() if key != "PIP_RETRIES"} | chosen
    done = subprocess.run([install, tmp_path, "a_package"], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"retries {retries}\n"
    assert "if an index cannot be reached" in done.stderr
    assert "unset PIP_EXTRA_INDEX_URL" in done.stderr


def test_make_setup_says_how_to_begin(tmp_path):
    """It ends with the next commands. Targets that need it install first, and once."""
    if not (ROOT / "Makefile").exists():
        pytest.skip("needs a checkout")
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    for name in (".ci/install", ".venv/bin/python", ".venv/bin/lint-imports"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / ".venv" / ".created").touch()
    line = "installed; '. .venv/bin/activate', and 'python -m hgn.rollout' simulates a scene\n"
    for i, target in enumerate(("layers", "format", "lint", "types", "docs", "film", "setup")):
        done = subprocess.run(["make", target], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert (line in done.stdout) == (i == 0)
