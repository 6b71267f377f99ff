"""Makes the solver's tests share kernels, because Taichi takes seconds to compile one.

A launch compiles a kernel for the materials of its scenes. Here each kernel has all materials, and takes densities of
particles. test_solver.py compares such kernels with those of single materials, bit for bit.
"""

import contextlib

import taichi as ti

from datagen.mpm import launch
from datagen.mpm.device import initialise
from datagen.mpm.layout import MATERIAL_VARIANTS, VARIANT


class AllMaterials:
    """The attribute `variant` of launches: what is written is read with all materials."""

    def __set__(self, launch, value):
        rate = VARIANT.rate_of_sand * (launch.config.sand_grain_diameter_m > 0)
        launch.__dict__["variant"] = value | sum(MATERIAL_VARIANTS) | VARIANT.several_laws | rate

    def __get__(self, launch, _):
        return launch.__dict__["variant"]


def start():
    """Starts Taichi with two threads, of which kernels use one: the tests' other processes need the other core."""
    initialise("cpu", 2)
    use_threads(1)
    launch.Launch.variant = AllMaterials()


@contextlib.contextmanager
def kernels_of_their_own():
    """Launches compile kernels for their own materials, on two threads."""
    del launch.Launch.variant
    use_threads(2)
    try:
        yield
    finally:
        start()


def use_threads(number):
    """Sets the number of threads of kernels that are compiled from now on."""
    ti.lang.impl.get_runtime().prog.config().cpu_max_num_threads = number
