"""Names the extra that installs a missing package."""

import importlib.util
import sys

# The same names are in pyproject.toml.
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
    "wandb": "wandb",
    "mlflow": "mlflow",
}


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Returns the command that installs a missing package of an extra, or None for any other package."""
    package = (error.name or "").split(".")[0]
    if package not in EXTRA_OF:
        return None
    if package == "taichi" and sys.version_info >= (3, 13):
        return "this needs taichi, which is published only for Python 3.11 and 3.12; use one of them"
    return f"this needs {package}, which is not installed; pip install 'hgn[{EXTRA_OF[package]}]'"


def require_installed(package: str) -> None:
    """Checks for a package that a command imports hours after its start. Raises ModuleNotFoundError."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:  # any folder of that name is a package without an origin
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)
