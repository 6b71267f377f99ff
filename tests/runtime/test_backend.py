"""The choice of a backend: what runs where, what is said of it, and what is refused."""

import re
import shutil
import sysconfig
from types import SimpleNamespace

import pytest
import torch

from hgn.config import NetworkConfig
from hgn.network.build import build_network
from hgn.runtime.backend import choose, pick, triton_unsupported_reason
from hgn.runtime.torch_backend import precisions_to_try
from hgn.runtime.triton_host import host_unsupported_reason
from hgn.scene.material import MATERIALS, OWN_PHYSICS
from hgn.schema import ConfigError

GOLD, HALF = "it needs gold", "it does not support fp16"
CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize(
    ("backend", "precision", "reasons", "expected"),
    [
        ("auto", "tf32", (None, None), ("triton", "training backend: triton")),
        ("torch", "tf32", (None, None), ("torch", "training backend: torch")),
        ("auto", "tf32", (GOLD, None), ("torch", f"training backend: torch (not triton: {GOLD})")),
        ("triton", "tf32", (GOLD, None), "training.backend must be torch or auto here, got triton: it needs gold"),
        ("auto", "fp16", (GOLD, HALF), "precision must be tf32 or fp32 on backend torch, got fp16; triton: it"),
        ("torch", "fp16", (None, HALF), "got fp16; training.backend=torch was requested"),
    ],
)
def test_the_backend_is_chosen_and_said(backend, precision, reasons, expected):
    """auto takes backend triton where it runs, and reports it; another one is refused, never replaced silently."""
    given = dict(zip(("triton", "torch"), reasons, strict=True)), backend, precision, "training.backend"
    if isinstance(expected, tuple):
        assert pick(*given) == expected
    else:
        with pytest.raises(ConfigError, match=expected):
            pick(*given)


@pytest.mark.parametrize(
    ("kind", "precision", "backend", "expected"),
    [  # an HGN compiled C, unless torch is set; a GNS PyTorch; fp16 neither
        ("hgn", "tf32", "auto", "cpu"),
        ("hgn", "tf32", "torch", "torch"),
        ("hgn", "tf32", "cpu", "cpu"),
        ("gns", "tf32", "auto", "torch"),
        ("hgn", "fp16", "auto", "got fp16; triton: it needs a CUDA device"),
        ("gns", "fp16", "auto", "precision must be tf32 or fp32 on backend torch, got fp16; triton"),
        ("hgn", "tf32", "triton", "backend must be cpu or torch or auto here, got triton: it needs a CUDA device"),
        ("gns", "tf32", "cpu", "backend must be torch or auto here, got cpu: it computes hgn networks, not gns"),
    ],
)
def test_what_a_cpu_takes(kind, precision, backend, expected):
    """A network's backend on a CPU, or why it is refused."""
    network = build_network(NetworkConfig(width=16, kind=kind, levels=1))
    if " " not in expected:
        assert choose(CPU, network, precision, backend).name == expected
        return
    with pytest.raises(ConfigError, match=expected):
        choose(CPU, network, precision, backend)


@pytest.mark.parametrize(
    ("precision", "device", "backend", "expected"),
    [
        ("auto", GPU, "triton", ("fp16", "tf32")),
        ("auto", GPU, "torch", ("tf32",)),
        ("auto", CPU, "cpu", ("fp32",)),
        ("auto", CPU, "triton", ("fp32",)),
        ("tf32", GPU, "triton", ("tf32",)),
        ("fp16", GPU, "triton", ("fp16",)),
    ],
)
def test_automatic_precision(precision, device, backend, expected):
    """auto tries the precisions of a backend from the fastest on; a named precision has no alternative."""
    assert precisions_to_try(precision, device, backend) == expected


@pytest.mark.parametrize(
    ("device", "network", "precision", "reason"),
    [
        (GPU, {}, "tf32", ""),
        (GPU, {"inputs": "relative", "own_physics": OWN_PHYSICS, "materials": MATERIALS}, "tf32", ""),
        (CPU, {}, "tf32", "not cpu"),
        (GPU, {"kind": "gns", "levels": 1}, "tf32", "hgn networks, not gns"),
        (GPU, {"width": 48}, "tf32", "not 48"),
        (GPU, {}, "fp32", "in tf32 or fp16, not fp32"),
        (GPU, {"levels": 9}, "tf32", "at most 8"),
    ],
)
def test_why_backend_triton_does_not_run(device, network, precision, reason):
    """A CPU, GNS, an odd width and too many levels are each named."""
    found = triton_unsupported_reason(device, NetworkConfig(**network), precision)
    assert re.search(reason, found) if reason else found is None


def test_little_shared_memory(monkeypatch):
    """A GPU with 99 KB of shared memory takes backend torch, which says why; triton where the network is narrower."""
    small = SimpleNamespace(shared_memory_per_block_optin=101_376)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: small)
    monkeypatch.setattr("hgn.runtime.backend.host_unsupported_reason", lambda: None)
    reason = "its kernels need 160 KB of shared memory at width 128, and this GPU has 99"
    assert triton_unsupported_reason(GPU, NetworkConfig()) == reason
    assert reason in pick({"triton": reason, "torch": None}, "auto", "tf32", "backend")[1]
    assert triton_unsupported_reason(GPU, NetworkConfig(width=64)) is None


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
    """If backend triton is not available, backend torch runs and prints the reason. An explicit backend=triton raises
    an error with the package to install."""
    network = build_network(NetworkConfig(width=16))
    chosen = choose(GPU, network)
    assert chosen.name == "torch" and "Python.h" in chosen.note
    with pytest.raises(ConfigError, match="must be torch or auto here, got triton: Triton needs Python's headers"):
        choose(GPU, network, backend="triton")
