"""The solver, by Taichi."""

import inspect

# At the definition of each kernel Taichi requests the source of a frame of the import system, which has none. inspect
# would search all modules each time, which takes two seconds after an import of PyTorch.
for _name in ("_bootstrap", "_bootstrap_external"):
    inspect.modulesbyfile[f"<frozen importlib.{_name}>"] = f"importlib.{_name}"
