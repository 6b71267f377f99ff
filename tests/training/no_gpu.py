"""For programs that compile kernels where there is no GPU: Triton's driver as one that has an H100 for its target."""

from __future__ import annotations

from typing import Any

import triton

from hgn.kernels.triton_compat import use_target


class NoGpu:
    """What of a driver compiling asks for."""

    @staticmethod
    def launcher_cls(source: Any, metadata: Any) -> None: ...


def use_h100() -> None:
    triton.runtime.driver.set_active(NoGpu())
    use_target(90)
