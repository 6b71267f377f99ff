"""All tests of this folder use the same kernels."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def taichi_on_cpu(solver_kernels):
    pass
