"""The solver, by Taichi."""

import inspect

# For each kernel that is defined Taichi asks for the source of a frame of the import system, which has none: inspect
# would look through all modules each time, two seconds where PyTorch is loaded
for _name in ("_bootstrap", "_bootstrap_external"):
    inspect.modulesbyfile[f"<frozen importlib.{_name}>"] = f"importlib.{_name}"
