"""The service's log beside a reader that does not read."""

import os
import threading

from processes import wait_until

from datagen.service.log import UnhurriedLog


def test_who_writes_waits_for_nobody():
    """A reader receives lines in order. If it stops reading, lines are dropped and a later line reports this. If it
    closes the pipe, it receives nothing more. Writers never wait."""
    source, sink = os.pipe()
    with UnhurriedLog([sink]) as log:
        os.write(sink, b"first\n")
        assert os.read(source, 100) == b"first\n"
        writer = threading.Thread(target=lambda: [os.write(sink, 4096 * b"x") for _ in range(1000)])
        writer.start()
        wait_until(lambda: not writer.is_alive())
        wait_until(lambda: log.error == "its reader does not read it")
        taken = b""
        while b"lines are missing here" not in taken:
            taken += os.read(source, 2**16)
        assert len(taken) < 4_000_000
        os.close(source)
        os.write(sink, b"to nobody")
        wait_until(lambda: log.error == "Broken pipe")
    os.close(sink)
