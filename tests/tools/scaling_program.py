"""scaling_program.py MAPPING: python -m tools.scaling whose ranks are forks of this process, which has all loaded."""

import json
import sys
from functools import partial

import torch.multiprocessing

from tools import timing
from tools.scaling.command import main

timing.MINIMUM_ROUNDS = 1
torch.multiprocessing.spawn = partial(torch.multiprocessing.start_processes, start_method="fork")
sys.exit(main(json.loads(sys.argv[1])))
