"""`pytest --costs FILE`: what each file of tests and each fixture takes, over all workers, as a table and as JSON.
`python tests/support/costs.py FILE docs/test_costs.md` makes a page of it.

Processor time is that of the worker and of the processes that it waited for, apart: what a test starts is often dearer
than what it does. A process counts where it is waited for, so a browser counts in the file that closes it.
"""

import collections
import contextlib
import json
import os
import platform
import sys
import time

import pytest

SHOWN = 40

#: What kinds of work tests are about, by their files; the first that fits.
KINDS = {
    "kernels that tests compile": "core/test_kernel core/test_compiling coordinates/test_forward_only "
    "coordinates/test_kernel_gradients",
    "workers, kills and clusters": "jobs/ films/ cli/test_film",
    "the editor and its page in a browser": "editor/",
    "examples, wheels, docs and processes of their own": "contracts/test_examples contracts/test_install "
    "contracts/test_site contracts/test_threads contracts/test_processes contracts/test_quiet contracts/test_workflows "
    "contracts/test_benchmarks cli/test_cli_doctor",
    "hostile and drawn input": "contracts/test_hostile contracts/test_fuzz contracts/test_broken contracts/test_prop "
    "splats/test_splat_hostile field/test_broken",
    "fits and captures": "fitting/ captures/ scene/test_scene_sizes scene/test_ignored",
    "cages": "cage/",
    "poses and frames": "deform/ render/ view/ lattice/ coordinates/ field/ splats/ mesh/ demo/",
    "all others": "",
}


def clocks():
    """Processor time of this process and of those that it waited for, and the time of a clock, in seconds."""
    times = os.times()
    return times.user + times.system, times.children_user + times.children_system, time.perf_counter()


def pytest_addoption(parser):
    parser.addoption("--costs", metavar="FILE", help="write what files and fixtures take to FILE, and show the most")


def pytest_configure(config):
    if config.getoption("--costs"):
        config.pluginmanager.register(Costs(config), "costs of tests")


class Costs:
    """In a worker: puts what fixtures and tests take into their reports; in the process that shows: adds up reports."""

    def __init__(self, config):
        self.config, self.begin = config, clocks()
        self.inner = []  # what fixtures within the one that is being made took
        self.fixtures, self.files, self.tests = [collections.defaultdict(lambda: [0.0, 0.0, 0.0]) for _ in range(3)]
        self.workers = [0.0, 0.0, 0.0]
        self.made = []  # fixtures since the last report

    @contextlib.contextmanager
    def measured(self, keep):
        begin = clocks()
        yield
        keep([after - before for before, after in zip(begin, clocks(), strict=True)])

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef, request):
        def keep(taken):
            within = self.inner.pop()
            if self.inner:
                self.inner[-1] = add(self.inner[-1], taken)
            own = [a - b for a, b in zip(taken, within, strict=True)]
            self.made.append([f"{os.path.basename(fixturedef.baseid) or 'conftest.py'}::{fixturedef.argname}", *own])

        self.inner.append([0.0, 0.0, 0.0])
        with self.measured(keep):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        report = yield
        now, last = clocks(), getattr(self, "last", self.begin)
        self.last = now
        report.costs = [after - before for before, after in zip(last, now, strict=True)]
        report.fixture_costs, self.made = self.made, []
        return report

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item):
        self.last = clocks()  # what came before, collection and waiting for work, is no test's

    def pytest_runtest_logreport(self, report):
        costs = getattr(report, "costs", None)
        if costs is None or hasattr(self.config, "workerinput"):
            return
        path = report.nodeid.partition("::")[0]
        self.files[path] = add(self.files[path], costs)
        self.tests[report.nodeid] = add(self.tests[report.nodeid], costs)
        for name, *own in report.fixture_costs:
            self.fixtures[name] = add(self.fixtures[name], own)

    def pytest_sessionfinish(self, session):
        if hasattr(self.config, "workerinput"):
            self.config.workeroutput["costs"] = [b - a for a, b in zip(self.begin, clocks(), strict=True)]

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error):
        self.workers = add(self.workers, getattr(node, "workeroutput", {}).get("costs", [0.0, 0.0, 0.0]))

    def pytest_terminal_summary(self, terminalreporter):
        if hasattr(self.config, "workerinput"):
            return
        own = [after - before for before, after in zip(self.begin, clocks(), strict=True)]
        tests = [sum(each) for each in zip(*self.files.values(), strict=True)] or [0.0, 0.0, 0.0]
        rest = [max(0.0, a - b) for a, b in zip(self.workers, tests, strict=True)] if any(self.workers) else [0.0] * 3
        rows = {
            "files": dict(self.files),
            "fixtures": dict(self.fixtures),
            "tests": {name: costs for name, costs in self.tests.items() if sum(costs[:2]) > 1.0},
            "all": {"tests": tests, "collection and imports of workers": rest, "the process that hands tests out": own},
        }
        path = self.config.getoption("--costs")
        os.makedirs(os.path.dirname(os.path.abspath(path)), exist_ok=True)
        with open(path, "w", encoding="utf-8") as file:
            json.dump({kind: {name: [round(each, 2) for each in costs] for name, costs in table.items()}
                       for kind, table in rows.items()}, file, indent=1)  # fmt: skip
        write = terminalreporter.write_line
        for kind in ("all", "files", "fixtures"):
            terminalreporter.section(
                f"costs of {kind}: seconds of processor time, those of processes started, of a clock"
            )
            for name, costs in sorted(rows[kind].items(), key=lambda row: -sum(row[1][:2]))[:SHOWN]:
                write(f"{sum(costs[:2]):8.1f} {costs[1]:8.1f} {costs[2]:8.1f}  {name}")


def add(one, other):
    return [a + b for a, b in zip(one, other, strict=True)]


def kind_of(path):
    return next(kind for kind, names in KINDS.items() if not names or any(each in path for each in names.split()))


def page_of(costs):
    """A page of docs: where the processor time of a run goes, by kinds and by files."""
    kinds = collections.defaultdict(lambda: [0.0, 0.0, 0.0])
    for path, each in costs["files"].items():
        kinds[kind_of(path)] = add(kinds[kind_of(path)], each)
    compiled = costs["all"]["the process that hands tests out"]
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    tests = [sum(each) for each in zip(*costs["files"].values(), strict=True)]
    imports = costs["all"]["collection and imports of workers"]
    before = max(0.0, sum(compiled[:2]) - sum(tests[:2]) - sum(imports[:2]))
    lines = [
        "# What the tests cost",
        "",
        "Where the processor time of `python -m pytest` goes, written by `python -m pytest --costs FILE` and",
        "`python tests/support/costs.py FILE docs/test_costs.md`; `.ci/run` prints the table of each run. Processes",
        "that a test starts count where it waits for them; a browser and workers of a cluster hardly show.",
        "",
        f"{sum(compiled[:2]):.0f} s of processor time in {compiled[2]:.0f} s, {os.cpu_count()} cores, {machine}.",
        "",
        "| kind | processor, s | of it processes started |",
        "| --- | --- | --- |",
        f"| kernels compiled before the first test | {before:.0f} | |",
        f"| imports and collection by the workers | {sum(imports[:2]):.0f} | |",
    ]
    for kind, each in sorted(kinds.items(), key=lambda row: -sum(row[1][:2])):
        lines.append(f"| {kind} | {sum(each[:2]):.0f} | {each[1]:.0f} |")
    lines += ["", f"The {SHOWN} dearest files:", "", "| file | processor, s | of it processes started | clock, s |",
              "| --- | --- | --- | --- |"]  # fmt: skip
    for path, each in sorted(costs["files"].items(), key=lambda row: -sum(row[1][:2]))[:SHOWN]:
        lines.append(f"| `{path}` | {sum(each[:2]):.1f} | {each[1]:.1f} | {each[2]:.1f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as file:
        page = page_of(json.load(file))
    with open(sys.argv[2], "w", encoding="utf-8") as file:
        file.write(page)
