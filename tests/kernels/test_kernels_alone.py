"""Every kernel by itself against float64, of the numbers that it is given in a real pass: its outputs and gradients.

A whole network's gradients in TF32 or float16 differ by a hundredth from float64's, for some activations lie so close
to their kink that rounding turns their sign. What one kernel leaves is within its operands' rounding, at those signs.
Whether the right numbers go from one to the next is seen by the whole network in float32 (test_network).
`pytest -s` prints the largest error of each kernel and output.
"""

import importlib
import inspect
import pkgutil
from dataclasses import replace
from types import FunctionType

import pytest
import torch
from kernels import references
from kernels.cases import drawn, float32_state
from kernels.engines import device, engine_of, inference_of, run_forward
from kernels.launches import watched_engine
from network.states import network_of
from triton.runtime.jit import KernelInterface

import hgn.kernels
from hgn.kernels.backward import FusedTrainingNetwork
from hgn.kernels.tuning import Tuning
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import relative_error
from hgn.runtime.weights import find_weights, load_weights

NATIVE = device().type == "cuda"
BOUND = {"fp32": 1e-5, "tf32": 2e-3, "fp16": 2e-3}
LOSS_SCALE = {"fp16": 256.0}
ROOM = 2048 if NATIVE else 64  # for cells on each level

# Without products, in integers, float32 or float64 at every precision: of grids and neighbours, batches, optimisers,
# frames. Compared in test_network, test_images, test_update, test_training and test_rollout.
ELSEWHERE = {
    *("show_image", "mark_cells", "fill_tables", "prepare_particles", "prepare_features"),
    *("sum_motion", "deform", "prepare_relative_features"),
    *("sum_coarsest", "balance", "balance_backward", "add_coarsest"),
    *("sum_displacements", "find_deformation", "slow_displacements", "stop_slow"),
    *("draw_waves", "assemble_batch", "sum_errors", "sum_errors_above", "loss_gradient", "flag_overflow"),
    *("square_norm", "average_values"),
    *("finish_update", "adam", "momentum_directions", "step_blocks", "integrate", "advance"),
}

Table = dict[tuple[str, str, str], float]  # the largest error of a kernel's output at a precision


def all_kernels():
    """The kernels of all modules, by name."""
    result = {}
    for module in pkgutil.walk_packages(hgn.kernels.__path__, "hgn.kernels."):
        if module.name.endswith(".kernel"):
            for key, value in vars(importlib.import_module(module.name)).items():
                if isinstance(value, KernelInterface) and value.fn.__module__ == module.name and key[0] != "_":
                    result[key] = value
    return result


KERNELS = all_kernels()
REFERENCES = {k: f for k, f in vars(references).items() if isinstance(f, FunctionType) and k in KERNELS}


@pytest.fixture(scope="module")
def table():
    """Printed when all is done."""
    largest: Table = {}
    yield largest
    print()
    for (kernel, output, precision), error in sorted(largest.items()):
        print(f"{kernel:24} {output:24} {precision:8} {error:.1e}")


class Judge:
    """Compares launches with their references at one precision."""

    def __init__(self, table, precision):
        self.table, self.precision = table, precision
        self.kernels: set[str] = set()
        self.wrong: list[str] = []

    def __call__(self, launch):
        if launch.kernel in ELSEWHERE:
            return
        assert launch.kernel in REFERENCES, f"{launch.kernel} has no reference"
        self.kernels.add(launch.kernel)
        outputs = REFERENCES[launch.kernel](**launch.arguments())
        for output, found, expected, summands in launch.pairs(outputs):
            error = relative_error(found, expected)
            name = output.split()[0]  # of weights without their number
            self._note(launch.kernel, name, error)
            if summands > float(expected.norm()):
                error = float((found - expected).norm()) / summands
                self._note(launch.kernel, f"{name} (of summands)", error)
            if not error < BOUND[self.precision]:
                self.wrong.append(f"{launch.kernel}: {output} {error:.2e}")

    def _note(self, kernel, output, error):
        key = kernel, output, self.precision
        self.table[key] = max(error, self.table.get(key, 0.0))


def kernels_of(*modules):
    """Those that modules of hgn.kernels launch."""
    found = [vars(importlib.import_module(f"hgn.kernels.{module}")).values() for module in modules]
    return {value.__name__ for values in found for value in values if isinstance(value, KernelInterface)}


def judged(judge, engine, network, state):
    """A forward pass, and a backward pass where the engine has one. The grids' origins are those of space."""
    with watched_engine(judge, engine):
        run_forward(engine, network, state, torch.zeros_like(state.domain_S3))
        if isinstance(engine, FusedTrainingNetwork):
            _, weight_N3 = drawn(network, state)
            engine.output_gradient[: len(weight_N3), :3] = (weight_N3 / engine.unscale).float()
            engine.backward()
    assert int(engine.grid.status) == 0


def made(network, state, precision, room):
    """Tiles are larger in the interpreter, whose time goes by their number."""
    tuning = Tuning.of(precision)
    if not NATIVE:
        tuning = replace(tuning, cell_block=16, few_cells=0, row_block=64, small_block=64, pair_particles=4)
    capacities, scale = (room,) * network.config.levels, LOSS_SCALE.get(precision, 1.0)
    return engine_of(network, state, precision, capacities, loss_scale=scale, tuning=tuning)


@pytest.fixture
def many_rows(monkeypatch):
    """Every level is one of many rows, and so few programs run that each takes several tiles."""
    monkeypatch.setattr("hgn.kernels.tuning.FEW_ROWS", 0)
    monkeypatch.setattr("hgn.kernels.tuning.PROCESSORS", 2)
    monkeypatch.setattr("hgn.kernels.tuning.RESIDENT_PROGRAMS", 2)


def width_for(precision):
    """On a GPU the one that trainings have; compiling for it takes more than a second a kernel."""
    return 128 if NATIVE and precision in ("tf32", "fp16") else 16


def crowd(cell_size):
    """Three scenes of odd numbers of particles, the first five on borders, corners and centres of cells."""
    state = float32_state((301, 1, 131), spread=0.2) if NATIVE else float32_state((5, 1, 3), spread=0.06)
    halves = torch.tensor([[0, 0, 0], [1, 3, 2], [2, 2, 2], [2, 3, 1], [3, 2, 4]], dtype=torch.float64)
    state.position_N3[:5] = halves * cell_size / 2
    return state


@pytest.mark.parametrize("precision", ["tf32", "fp16"])
@pytest.mark.usefixtures("many_rows")
def test_several_scenes(precision, table):
    """Scenes of odd numbers of particles, one with a single one, one with particles on their cells' borders, and the
    kernels for many rows: every kernel that an engine has is within its bound."""
    network = network_of(width=width_for(precision), levels=2, message_passing_steps=2, cell_size=0.03125)
    state = crowd(network.config.cell_size)
    judge, engine = Judge(table, precision), made(network, state, precision, ROOM)
    judged(judge, engine, network, state)
    assert not judge.wrong and (engine.grid.weight_N8[:5] == 0).any()  # cells on whose borders particles are
    if precision != "tf32":
        assert judge.kernels == kernels_of("forward", "backward")


@pytest.mark.parametrize("precision", ["tf32", "fp16"])
def test_one_particle(precision, table):
    """A single particle, and the kernels for few rows. What is left of the gradient of the pairs' offsets is a fifth of
    its summands here, and by itself misses the bound."""
    network = network_of(width=width_for(precision), levels=1, message_passing_steps=2)
    state = float32_state((1,), spread=0.06, seed=6)
    judge = Judge(table, precision)
    judged(judge, made(network, state, precision, 16), network, state)
    assert not judge.wrong


@pytest.mark.parametrize("precision", ["tf32", "fp16"])
def test_empty_levels(precision, table):
    """Without particles no level has a cell: nothing is written, and gradients are zero."""
    network = network_of(width=width_for(precision), levels=2, message_passing_steps=2)
    state = float32_state((2,))
    judge = Judge(table, precision)
    engine = made(network, state, precision, 32)
    engine.particle_count.zero_()
    judged(judge, engine, network, state)
    assert not judge.wrong and not engine.grid.counts_L.any()
    assert not engine.totals.any() and not engine.output.any()


@pytest.mark.parametrize(("precision", "half_cells", "half_sums"), [("tf32", False, False), ("fp16", True, True)])
@pytest.mark.usefixtures("many_rows")
def test_inference(precision, half_cells, half_sums, table):
    """The kernels where nothing is kept for gradients and buffers are shared, in fp16 with cells rounded
    between kernels, and so summed."""
    network = network_of(width=width_for(precision), levels=2, message_passing_steps=2, cell_size=0.03125)
    state = crowd(network.config.cell_size)
    judge = Judge(table, precision)
    engine = inference_of(made(network, state, precision, ROOM), network, half_cells, half_sums)
    judged(judge, engine, network, state)
    assert not judge.wrong


@pytest.mark.gpu
@pytest.mark.skipif(not NATIVE, reason="the same kernels as in test_several_scenes, of width 128")
@pytest.mark.parametrize("precision", ["tf32", "fp16"])
def test_a_trained_network(precision, table):
    """A shipped one, of width 128, with two iterations on each of four levels."""
    network, _ = load_weights(find_weights("obstacles_small"))
    assert isinstance(network, HierarchicalGraphNetwork)
    judge, state = Judge(table, precision), float32_state((300, 131), spread=0.2)
    judged(judge, made(network.double(), state, precision, ROOM), network, state)
    assert not judge.wrong


def test_no_kernel_is_left_out():
    """Every kernel has a reference, whose arguments are the kernel's, or is compared elsewhere."""
    assert KERNELS.keys() == REFERENCES.keys() | ELSEWHERE and not REFERENCES.keys() & ELSEWHERE
    for name, function in REFERENCES.items():
        arguments = inspect.signature(function).parameters.keys() - {"_"}
        assert arguments <= set(KERNELS[name].arg_names), name
