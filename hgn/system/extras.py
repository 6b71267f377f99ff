"""Which of the package's extras brings a package that a command needs and does not find."""

from __future__ import annotations

import importlib.util
import sys

# as pyproject.toml lists them
EXTRA_OF = {
    "taichi": "datagen",
    "lightning": "train",
    "lightning_utilities": "train",
    "matplotlib": "train",
    "tensorboard": "train",
    "aiohttp": "service",
    "fsspec": "service",
    "h11": "service",
    "starlette": "service",
    "uvicorn": "service",
    "google_crc32c": "import",
    "huggingface_hub": "hub",
    "pxr": "files",
    "pysplashsurf": "files",
    "onnx": "onnx",
    "onnxscript": "onnx",
    "viser": "play",
    "ray": "ray",
    "s3fs": "s3",
}


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """What to install, in words, where the package that is missing belongs to an extra; None for any other."""
    package = (error.name or "").split(".")[0]
    if package not in EXTRA_OF:
        return None
    if package == "taichi" and sys.version_info >= (3, 13):
        return "this needs taichi, which is published for Python 3.11 and 3.12 alone; use one of them"
    return f"this needs {package}, which is not installed; pip install 'hgn[{EXTRA_OF[package]}]'"


def require_installed(package: str) -> None:
    """For commands that import the package hours after their start. Raises: ModuleNotFoundError."""
    if importlib.util.find_spec(package) is None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)
