"""Contains the Triton kernels, and prepares Triton's environment before the definition of a kernel."""

import os
from pathlib import Path

from hgn.system.machine import writable_folder

# A product and an added number round once. Triton 3.9 warns about this default, and Triton 3.10 would change it.
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")
if not {"TRITON_CACHE_DIR", "TRITON_HOME"} & os.environ.keys():
    _usual = Path(os.path.expanduser("~")) / ".triton" / "cache"  # noqa: PTH111 - Path's function raises without a home folder
    _folder = writable_folder(_usual, "triton")
    if _folder != _usual:
        os.environ["TRITON_CACHE_DIR"] = str(_folder)
