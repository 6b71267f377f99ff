"""Triton kernels, in Triton, whose surroundings are settled here before any of them is defined."""

import os
from pathlib import Path

from hgn.system.machine import writable_folder

# a product and a sum beside it round once: what Triton 3.9 warns of and 3.10 would change
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")
if not {"TRITON_CACHE_DIR", "TRITON_HOME"} & os.environ.keys():
    _usual = Path(os.path.expanduser("~")) / ".triton" / "cache"  # noqa: PTH111 - Path's raises where there is none
    _folder = writable_folder(_usual, "triton")
    if _folder != _usual:
        os.environ["TRITON_CACHE_DIR"] = str(_folder)
