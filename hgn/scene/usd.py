"""Meshes and particles of USD files, as hgn.scene.usd_program reads them with bounded memory and time.

Lengths become domain units: a metre is one domain unit, and y points up. Animated values are those of their first
sample. Subdivision surfaces are their polygons.
"""

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from hgn.scene.npz import read_npz
from hgn.system.claims import most_bytes
from hgn.system.extras import require_installed

COPIES = 4  # arrays of pxr, of NumPy, joined, and as npz


def read_usd_polygons(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns vertices, float64 [V, 3], and the vertices of each polygon of all visible meshes. Raises as `_read`."""
    arrays = _read("meshes", path)
    return arrays["vertex"], np.split(arrays["corner"], np.cumsum(arrays["count"])[:-1]) if len(arrays["count"]) else []


def read_usd_particles(path: Path, material: str) -> dict[str, np.ndarray]:
    """Returns `position` and `velocity`, float64 [N, 3], of points of this material or of none. Raises as `_read`."""
    return _read("particles", path, material)


def _read(content: str, path: Path, *more: str) -> dict[str, np.ndarray]:
    """Raises: ValueError for unsupported, damaged or too large content; ModuleNotFoundError without pxr."""
    require_installed("pxr")
    most = most_bytes(path.stat().st_size)
    program = [sys.executable, "-P", str(Path(__file__).with_name("usd_program.py"))]
    one_thread = dict(os.environ, PXR_WORK_THREAD_LIMIT="1", OPENBLAS_NUM_THREADS="1")  # each thread takes memory
    arguments = [content, str(path.resolve()), str(COPIES * most), *more]
    done = subprocess.run([*program, *arguments], capture_output=True, env=one_thread, check=False)
    lines = [line for line in done.stderr.decode(errors="replace").splitlines() if re.search("[a-z]{3}", line)] or [""]
    last = "".join(filter(str.isprintable, lines[-1]))
    if done.returncode == 3:
        raise ValueError(f"it {last}")
    if done.returncode:
        rule = "it is damaged, or needs more memory or time than files of its size"
        raise ValueError(f"{rule}: {last[:200]}" if last else rule)
    return dict(read_npz(io.BytesIO(done.stdout)))
