"""Taichi on two CPU threads for all tests of this folder."""

import pytest

from datagen.mpm.device import initialise


@pytest.fixture(scope="session", autouse=True)
def taichi_on_cpu():
    initialise("cpu", 2)
