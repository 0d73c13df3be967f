"""Processor time of every test, which another load on the machine hardly changes."""

import resource
from collections import Counter

import pytest

NAME = "processor seconds"
SHOWN = 25


def processor_seconds():
    """User and system time of this process and of those that it has waited for."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in both)


class ProcessorTimes:
    """Plugin that tells at the end which files and tests took most; workers tell theirs too."""

    def __init__(self):
        self.of_tests = Counter()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item):
        yield from _measured(item)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_call(self, item):
        yield from _measured(item)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item):
        yield from _measured(item)

    def pytest_runtest_logreport(self, report):
        if report.when == "teardown":
            self.of_tests[report.nodeid] += sum(
                value for name, value in report.user_properties if name == NAME
            )

    def pytest_terminal_summary(self, terminalreporter):
        of_files = Counter()
        for name, seconds in self.of_tests.items():
            of_files[name.partition("::")[0]] += seconds
        write = terminalreporter.write_line
        write(f"{sum(of_files.values()):.0f} {NAME}, without imports and collection")
        for found in (of_files, self.of_tests):
            for name, seconds in found.most_common(SHOWN):
                write(f"{seconds:8.2f} {name}")


def _measured(item):
    """One phase of a test; its set-up has that of the fixtures that it is the first to ask for."""
    before = processor_seconds()
    try:
        yield
    finally:
        item.user_properties.append((NAME, processor_seconds() - before))
