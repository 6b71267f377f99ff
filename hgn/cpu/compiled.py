"""Computes rows of an MLP on a CPU in one pass with rows.c; hgn.cpu.rows is the reference.

PyTorch writes and reads every intermediate result of a block of rows. rows.c keeps a few rows at a time in the fastest
cache from the gather to the sums. The machine's C compiler compiles rows.c for its CPU, once for each width, into
`$XDG_CACHE_HOME/hgn/rows` (by default `~/.cache/hgn/rows`). Without a compiler PyTorch computes the rows.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from weakref import WeakKeyDictionary

import torch

from hgn.cpu.rows import Hidden, Rows, Segments
from hgn.system.files import sync_written, temporary_file

SOURCE = Path(__file__).with_name("rows.c")
# No flag lets the compiler reorder sums, so the result of a row does not depend on the rows around it.
FLAGS = ("-std=gnu11", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
LANES = 16  # float32 numbers in a vector of AVX-512
WIDEST = 512  # largest width whose two matrices fit on a thread's stack
COMPILERS = ("cc", "gcc", "clang")
_KNOWN: "WeakKeyDictionary[torch.nn.Module, CompiledRows]" = WeakKeyDictionary()


def unsupported_reason(width: int, dtype: torch.dtype) -> str | None:
    """Returns the reason for which rows.c cannot compute the rows, or None."""
    if dtype != torch.float32:
        return f"it computes float32, not {dtype}"
    if width % LANES or width > WIDEST:
        return f"network.width must be a multiple of {LANES}, at most {WIDEST}, for it, not {width}"
    return _library(width)[1]


def rows_class(width: int, dtype: torch.dtype) -> Callable[[torch.nn.Module], Rows]:
    """Returns the function that returns the rows of an MLP."""
    return Rows if unsupported_reason(width, dtype) else compiled_rows


def describe(width: int) -> str:
    """Returns how float32 rows are computed, and why, as text."""
    reason = unsupported_reason(width, torch.float32)
    return "rows compiled for this CPU" if reason is None else f"rows in PyTorch ({reason})"


def compiled_rows(network: torch.nn.Module) -> "CompiledRows":
    """Returns the rows of an MLP, cached while its parameters keep their addresses."""
    known = _KNOWN.get(network)
    if known is None or known.places != known.places_now():
        known = _KNOWN[network] = CompiledRows(network)
    return known


class CompiledRows(Rows):
    """Computes rows of an MLP whose layers have equal widths. For other MLPs it computes only projections.

    It stores the parameters' addresses, not their values, so that results follow updates of the parameters in place.
    """

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__(network)
        library = _library(self.second.shape[0])[0]
        assert library is not None
        self._project, self._outputs = library.project, library.outputs
        if self.norm is not None:
            gain, shift, epsilon = self.norm
            self._second = *map(_place, (self.second.T, self.second_bias, gain, shift)), epsilon
        # Module.parameters() of all MLPs would take 2 ms in each frame
        self._owned = [module._parameters for module in network.modules()]
        self.places = self.places_now()

    def places_now(self) -> list[int]:
        """Returns the addresses of all parameters."""
        return [each.data_ptr() for owned in self._owned for each in owned.values() if each is not None]

    def project(self, part: int, value: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
        out = value.new_empty(value.shape[0], self.parts[part].shape[1])
        self.project_into(out, part, value, bias)
        return out

    def project_into(self, out: torch.Tensor, part: int, value: torch.Tensor, bias: torch.Tensor | None = None) -> None:
        rows, depth = value.shape
        self._project(rows, _place(value), depth, *self._part(part), _place(bias), _place(out))

    def output(self, out_RW: torch.Tensor, hidden: Hidden, residual_RW: torch.Tensor | None = None) -> None:
        self._run(out_RW.shape[0], hidden, residual_RW, out_RW, None, None)

    def add_sums(self, sum_SW: torch.Tensor, hidden: Hidden, segments: Segments) -> None:
        self._run(segments.rows, hidden, None, None, sum_SW, segments)

    def output_and_add_sums(
        self, sum_SW: torch.Tensor, hidden: Hidden, segments: Segments, residual_RW: torch.Tensor | None
    ) -> torch.Tensor:
        out_RW = sum_SW.new_empty(segments.rows, sum_SW.shape[1]) if residual_RW is None else residual_RW
        self._run(segments.rows, hidden, residual_RW, out_RW, sum_SW, segments)
        return out_RW

    def _run(
        self,
        rows: int,
        hidden: Hidden,
        residual_RW: torch.Tensor | None,
        out_RW: torch.Tensor | None,
        sum_SW: torch.Tensor | None,
        segments: Segments | None,
    ) -> None:
        table_KW, chosen, each, part, value_RW = hidden
        self._outputs(
            rows,
            *(_place(table_KW), _place(chosen), each),
            *(_place(value_RW), self.parts[part].shape[0], *self._part(part), self.slope),
            *self._second,
            *(_place(residual_RW), _place(out_RW)),
            *((None, None) if segments is None else (_place(segments.weight_R), _place(segments.offset))),
            _place(sum_SW),
        )

    def _part(self, part: int) -> tuple[int, int]:
        """Returns the address of a part of the first layer's matrix [W, in], and its row stride."""
        one, columns = self.parts[part].stride()
        assert one == 1
        return self.parts[part].data_ptr(), columns


def _place(tensor: torch.Tensor | None) -> int | None:
    """Returns the address of a contiguous tensor."""
    if tensor is None:
        return None
    assert tensor.is_contiguous()
    return tensor.data_ptr()


@functools.cache
def _library(width: int) -> tuple[ctypes.CDLL | None, str | None]:
    """Returns the functions of rows.c for a width, or the reason why there are none."""
    options = (*FLAGS, f"-DWIDTH={width}")
    try:
        key = hashlib.sha256(repr((SOURCE.read_bytes(), options, _cpu())).encode()).hexdigest()
        path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hgn" / "rows" / f"{key[:32]}.so"
        if not path.exists():
            compiler = shlex.split(os.environ.get("CC", "")) or list(filter(shutil.which, COMPILERS))[:1]
            if not compiler:
                return None, f"it needs a C compiler: {', '.join(COMPILERS)} or CC=…"
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary_file(path) as temporary:  # other processes may compile the file at the same time
                command = [*compiler, *options, str(SOURCE), "-o", str(temporary)]
                subprocess.run(command, check=True, capture_output=True, text=True)
                sync_written(temporary)
                temporary.replace(path)
        return _load(path), None
    except subprocess.CalledProcessError as error:
        return None, f"{compiler[0]} does not compile {SOURCE.name}: {error.stderr.strip()[:200]}"
    except (OSError, RuntimeError) as error:  # no compiler, no home folder, or no permission
        return None, str(error)


def _load(path: Path) -> ctypes.CDLL:
    """Loads a compiled rows.c; its functions release the interpreter's lock."""
    library = ctypes.CDLL(str(path))
    pointer, count, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float
    library.project.argtypes = [count, pointer, count, pointer, count, pointer, pointer]
    library.outputs.argtypes = [
        *(count, pointer, pointer, count, pointer, count, pointer, count, number),
        *(pointer, pointer, pointer, pointer, number),
        *(pointer, pointer, pointer, pointer, pointer),
    ]
    library.project.restype = library.outputs.restype = None
    return library


def _cpu() -> list[str]:
    """Returns the properties on which `-march=native` depends, because machines may share the cache folder."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
    fields = ("vendor_id", "cpu family", "model", "stepping", "flags", "CPU ", "Features")
    return [platform.machine(), *(line for line in lines if line.startswith(fields))]
