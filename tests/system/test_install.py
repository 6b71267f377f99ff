"""The installation of `make setup` and `make demo`, with stand-ins for uv and pip."""

import os
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
