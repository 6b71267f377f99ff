"""Replaces the interpreter: sends its arguments to warm_server.py and ends like the program there.

`python -SEs warm_client.py SOCKET [-u] (-m MODULE | -c TEXT | FILE) ARGUMENTS`; WARM_PARENT in the environment of the
program is the process that started this one.
"""

import json
import os
import signal
import socket
import sys

FORWARDED = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP, signal.SIGQUIT)


def main(path, arguments):
    waiting: list[int] = []
    for number in FORWARDED:
        signal.signal(number, lambda number, _: waiting.append(number))
    server = socket.socket(socket.AF_UNIX)
    server.connect(path)
    environment = dict(os.environ, WARM_PARENT=str(os.getppid()))
    request = {"arguments": arguments, "cwd": os.getcwd(), "environment": environment}  # noqa: PTH109 - loads slowly
    request["network"] = f"/proc/{os.getpid()}/ns/net"
    data = json.dumps(request).encode() + b"\n"
    sent = socket.send_fds(server, [data], [0, 1, 2])
    server.sendall(data[sent:])
    answers = server.makefile()
    program = int(answers.readline())
    for number in FORWARDED:
        signal.signal(number, lambda number, _: os.kill(program, number))
    for number in waiting:
        os.kill(program, number)
    status = int(answers.readline())
    if status < 0:
        if -status != signal.SIGKILL:
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status)


main(sys.argv[1], sys.argv[2:])
