"""Tests of the ROS layer and of whole runs have a ROS domain of their own, on this host only."""

import importlib.util
import os
import sys
from collections.abc import Iterator
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

# before anything imports rclpy
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
# before anything imports torch: on small networks a second thread only waits for the first
os.environ['OMP_NUM_THREADS'] = '1'

import hypothesis
import pytest

# how long an example takes says nothing on a machine that does other things too
hypothesis.settings.register_profile('untimed', deadline=None)
hypothesis.settings.load_profile('untimed')

ROS = importlib.util.find_spec('rclpy') is not None
collect_ignore_glob = [] if ROS else ['ros/*', 'graph/*']


PENDING = 4
"""More units than pytest-xdist gives to a process before it has done the first of them."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Where tests run side by side, those that share a fixture of their module stay together, and
    at most every second process has whole runs, each of which is half a dozen processes more.

    (pytest-xdist's own groups, `--dist loadgroup`, have no effect with pytest 9.2.)
    """
    from xdist.scheduler import LoadScopeScheduling

    class BySharedFixture(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            module = nodeid.split('::', maxsplit=1)[0]
            return module if shares_a_fixture(config.rootpath / module) else nodeid

        def _has_whole_runs(self, node: Any) -> bool:
            newest = islice(reversed(self.assigned_work.get(node, {}).items()), PENDING)
            return any(is_whole_run(scope) and not all(unit.values()) for scope, unit in newest)

        def _assign_work_unit(self, node: Any) -> None:
            busy = sum(self._has_whole_runs(other) for other in self.nodes if other is not node)
            wanted = not busy or 2 * (busy + 1) <= len(self.nodes)
            first = next((s for s in self.workqueue if is_whole_run(s) == wanted), None)
            if first is not None:
                self.workqueue.move_to_end(first, last=False)
            super()._assign_work_unit(node)

    return BySharedFixture(config, log) if config.getvalue('dist') == 'loadscope' else None


def is_whole_run(nodeid: str) -> bool:
    """Whether a test, or a module of tests, is one of whole runs over topics."""
    return nodeid.startswith('tests/graph/')


@cache
def shares_a_fixture(module: Path) -> bool:
    """Whether a module makes something once for several of its tests."""
    return "scope='module'" in module.read_text()


def pytest_report_header() -> str:
    return 'ROS: found' if ROS else 'ROS: rclpy is missing, tests/ros and tests/graph are left out'


@pytest.fixture(scope='session', autouse=True)
def _end_of_the_fork_server() -> Iterator[None]:
    yield
    if (forked := sys.modules.get('helpers.forked')) is not None:
        forked.end_server()


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that nobody else uses meanwhile, for this test and its processes."""
    from domain_coordinator import domain_id

    with domain_id() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        yield int(domain)


@pytest.fixture(autouse=True)
def _own_ros_domain(request: pytest.FixtureRequest) -> None:
    if {'ros', 'graph'} & set(request.path.parent.parts):
        request.getfixturevalue('ros_domain')


@pytest.fixture(autouse=True)
def _own_random_numbers() -> None:
    """What a test draws from torch's global generator does not depend on the tests before it."""
    if 'torch' in sys.modules:
        sys.modules['torch'].manual_seed(0)
