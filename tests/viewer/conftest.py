"""A page of hgn.play for tests without a browser."""

import numpy as np
import pytest
import torch
from network.states import network_of, silent

from hgn.runtime.simulator import Simulator
from hgn.scene.scene import Scene


@pytest.fixture(scope="module")
def page():
    """A page whose loop does not run, with a network that leaves particles where they are."""
    pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
    from hgn.viewer.page import PlayPage
    from hgn.viewer.session import PlaySession

    network = silent(network_of(torch.float32, width=16, levels=2, inputs="relative"))
    block_N3 = 0.4 + 0.2 * np.random.default_rng(0).random((100, 3)).astype(np.float32)
    cone = {"shape": "cone", "size": 0.3, "position": (0.5, 0.5, 0.5)}
    scene = Scene(
        block_N3,
        0 * block_N3,
        np.zeros(100, np.uint8),
        cell_size=1 / 32,
        gravity=(0.0, 0.0, 0.0),
        specification={"obstacles": [cone]},
    )
    session = PlaySession(Simulator(network, 60.0, "cpu"), scene, weights="floating")
    loaded = []

    def load(name):
        loaded.append(name)
        return session.simulator

    page = PlayPage(session, ("floating", "other"), load, port=0)
    page.loaded = loaded
    yield page
    page.close()


@pytest.fixture
def messages(page, monkeypatch):
    """The messages that viewers have seen."""
    seen = []
    monkeypatch.setattr(page, "_notify", lambda message, client=None: seen.append(message))
    return seen
