"""Lets idle threads of PyTorch sleep instead of spinning on a CPU; must be imported before torch.

A frame is thousands of short products, each shared by all threads. Where other programs want the cores too, threads
that spin take them from the one that is waited for: on two busy cores a frame took 4 s instead of 0.1.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
