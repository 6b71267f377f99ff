"""Lets idle threads of PyTorch sleep instead of spinning on a CPU; must be imported before torch.

A frame consists of thousands of short parallel products. Spinning threads take cores from the thread that the others
wait for when other programs run too: on two busy cores a frame took 4 s instead of 0.1.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
