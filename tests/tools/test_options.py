"""Wrong options of the reports: each is named with its rule before anything is measured."""

import re

import pytest

from hgn.schema import ConfigError, from_mapping
from tools.bench.config import BenchConfig
from tools.curves import CurvesConfig
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.scaling.measure import ScalingConfig
from tools.stability.network import StabilityNetworkConfig
from tools.stability.solver import StabilitySolverConfig

GIVEN = {  # what each must be given
    BenchConfig: {},
    CurvesConfig: {"runs": ["a"], "out": "curves"},
    ErrorVsTimeConfig: {"data": "d", "out": "o"},
    ScalingConfig: {},
    StabilityNetworkConfig: {"weights": "w"},
    StabilitySolverConfig: {},
}


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (BenchConfig, {"cases": ["frames"]}, "cases[0] must be one of frame, torch_frame"),
        (BenchConfig, {"particles": [0]}, "particles[0] must be at least 1"),
        (BenchConfig, {"precisions": ["fp8"]}, "precisions[0] must be one of fp32, tf32, fp16"),
        (BenchConfig, {"seconds": 0}, "seconds must be a finite number > 0"),
        (
            BenchConfig,
            {"cases": ["public_gns_train"]},
            "public_gns must be a folder with the public code for public_gns_t",
        ),
        (CurvesConfig, {"runs": ["a/x", "b/x"]}, "runs must be folders of different names"),
        (ErrorVsTimeConfig, {"data": None}, "data must be a data set, got None; make one with python -m datagen, or"),
        (ErrorVsTimeConfig, {"mpm_grids": [4]}, "mpm_grids[0] must be at least 8"),
        (
            ErrorVsTimeConfig,
            {"weights": ["a/x.safetensors", "b/x.safetensors"]},
            "weights must be files of different names",
        ),
        (ErrorVsTimeConfig, {"frames": 1}, "frames must be at least 2"),
        (ErrorVsTimeConfig, {"precisions": ["fp8"]}, "precisions[0] must be one of fp32, tf32, fp16"),
        (ErrorVsTimeConfig, {"split": "all"}, "split must be one of train"),
        (ScalingConfig, {"devices": 0}, "devices must be at least 1"),
        (ScalingConfig, {"device": "cuda:1"}, "device must be auto, cpu or cuda"),
        (ScalingConfig, {"batches": 0}, "batches must be at least 1"),
        (ScalingConfig, {"backends": ["slow"]}, "backends[0] must be torch or triton"),
        (ScalingConfig, {"network": {"kind": "gns", "levels": 1}}, "network.kind must be hgn"),
        (StabilityNetworkConfig, {"cases": ["wide"]}, "cases[0] must be one of throw"),
        (StabilityNetworkConfig, {"frames": 1}, "frames must be at least 2"),
        (StabilityNetworkConfig, {"precision": "fp8"}, "precision must be one of fp32, tf32, fp16"),
        (StabilityNetworkConfig, {"backend": "quick"}, "backend must be one of auto, torch, triton, cpu"),
        (StabilitySolverConfig, {"cases": ["stesp"]}, "cases[0] must be one of steps"),
        (
            StabilitySolverConfig,
            {"cases": ["leak"], "picture": "steps.png"},
            "picture must be left out without the case",
        ),
        (
            StabilitySolverConfig,
            {"cases": ["grid"], "grid_cells": [16, 8, 12]},
            "grid_cells must be three or more rising numbers",
        ),
    ],
)
def test_bad_options(config, change, message):
    """Each is answered by its name, the rule and what was seen."""
    with pytest.raises(ConfigError, match=re.escape(message)):
        from_mapping(config, GIVEN[config] | change)
