"""hgn.runtime.triton_host: what is missing is named, and backend triton does not begin without it."""

import shutil
import sysconfig

import pytest
import torch

from hgn.config import NetworkConfig
from hgn.network.build import build_network
from hgn.runtime.backend import choose
from hgn.runtime.triton_host import host_unsupported_reason
from hgn.schema import ConfigError


@pytest.fixture
def host(tmp_path, monkeypatch):
    """A machine with a GPU, nothing compiled yet, a compiler and no headers."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(tmp_path / "include")})
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/clang" if name == "clang" else None)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "cache"))
    for name in ("CC", "CPATH", "C_INCLUDE_PATH"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_what_is_missing(host, monkeypatch):
    """Headers, then a compiler; nothing with both, or CC, or where they were used before."""
    assert f"headers: {host}/include/Python.h, on Debian" in str(host_unsupported_reason())
    (host / "more").mkdir()
    (host / "more" / "Python.h").touch()
    with monkeypatch.context() as patch:
        patch.setenv("CPATH", f"/nowhere:{host}/more")
        assert host_unsupported_reason() is None
    (host / "include").mkdir()
    (host / "include" / "Python.h").touch()
    assert host_unsupported_reason() is None
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert host_unsupported_reason() == "Triton needs a C compiler: gcc, clang or CC=…"
    monkeypatch.setenv("CC", "/opt/cc")
    assert host_unsupported_reason() is None
    monkeypatch.delenv("CC")
    (host / "cache" / "ABC").mkdir(parents=True)
    (host / "cache" / "ABC" / "cuda_utils.so").touch()
    assert host_unsupported_reason() is None


def test_it_is_said(host):
    """Backend torch runs instead, and says why; who asks for triton is told what to install."""
    device, network = torch.device("cuda"), build_network(NetworkConfig(width=16))
    chosen = choose(device, network)
    assert chosen.name == "torch" and "Python.h" in chosen.note
    with pytest.raises(ConfigError, match="must be torch or auto here, got triton: Triton needs Python's headers"):
        choose(device, network, backend="triton")
