"""For programs that compile kernels where there is no GPU: Triton's driver as one that has an H100 for its target."""

import triton

from hgn.kernels.triton_compat import use_target


class NoGpu:
    """Replaces the parts of a driver that compilation uses."""

    @staticmethod
    def launcher_cls(source, metadata): ...


def use_h100():
    triton.runtime.driver.set_active(NoGpu())
    use_target(90)
