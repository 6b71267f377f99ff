"""`python strange_program.py [NAMES]` reads each file of strange_files.py in a process of its own, with 2 GB and 20
seconds of a core, and prints how that ended.
"""

import gc
import json
import os
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

from data import strange_data, strange_scenes
from data.strange_files import CASES

from hgn.schema import ConfigError

MEMORY_BYTES, CPU_S = 2 * 10**9, 20
assert strange_data and strange_scenes


def outcome(name, folder):
    """How one case ended: `refused: …`, `read`, an exception, or the signal that ended its process."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        signal.alarm(600)  # for what waits instead
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        warnings.simplefilter("error", RuntimeWarning)
        try:
            CASES[name](folder)
            text = "read"
        except ConfigError as error:
            text = f"refused: {error}"
        except BaseException as error:  # noqa: BLE001 - told
            text = f"{type(error).__name__}: {error}"[:500] + "".join(traceback.format_tb(error.__traceback__)[-2:])
        os.write(writer, text.encode()[:4000])
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        text = file.read()
    _, status, used_ = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    return {"text": text or f"signal {-code}", "cpu_s": used_.ru_utime + used_.ru_stime, "kB": used_.ru_maxrss}


def main(wanted):
    gc.freeze()  # else each child's collections copy all that was loaded
    for name in CASES:
        if wanted in name:
            with tempfile.TemporaryDirectory() as folder:
                print(json.dumps({"name": name} | outcome(name, Path(folder))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "")
