"""Which process runs which tests."""

from types import SimpleNamespace

from file_scheduling import FileScheduling, place_of
from xdist.remote import Producer


class Process:
    """What pytest-xdist's scheduler asks of a process."""

    def __init__(self, name):
        self.gateway = SimpleNamespace(id=name)
        self.shutting_down = False
        self.numbers: list[int] = []

    def send_runtest_some(self, numbers):
        self.numbers += numbers

    def shutdown(self):
        self.shutting_down = True


def test_one_process_runs_a_file(pytestconfig):
    """A file's tests stay together; all that simulate are one group; long files begin first."""
    files = ("scene/test_a", "datagen/mpm/test_b", "tools/test_c", "tools/test_stability_d", "viewer/test_page")
    tests = [f"tests/{file}.py::test_{number}[a@b::c]" for number in range(4) for file in files]
    tests.sort(key=place_of)
    option = SimpleNamespace(tx=["2*popen"], loadscopereorder=True, maxprocesses=None)
    config = SimpleNamespace(option=option, getvalue=lambda name: getattr(option, name))
    scheduler = FileScheduling(config, Producer("", enabled=False))
    processes = [Process("a"), Process("b")]
    for process in processes:
        scheduler.add_node(process)
        scheduler.add_node_collection(process, tests)
    scheduler.schedule()
    done = {process.gateway.id: [] for process in processes}
    while any(len(done[process.gateway.id]) < len(process.numbers) for process in processes):
        for process in processes:
            own = done[process.gateway.id]
            if len(own) < len(process.numbers):
                own.append(process.numbers[len(own)])
                scheduler.mark_test_complete(process, own[-1])
    assert sorted(done["a"] + done["b"]) == list(range(len(tests)))
    homes = {file: {name for name, own in done.items() for n in own if file in tests[n]} for file in files}
    assert all(len(home) == 1 for home in homes.values())
    assert homes["datagen/mpm/test_b"] == homes["tools/test_stability_d"]
    assert {tests[done[name][0]].split("::")[0] for name in done} == {
        "tests/viewer/test_page.py",
        "tests/datagen/mpm/test_b.py",
    }
