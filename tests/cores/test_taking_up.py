"""A run in process that was ended at any moment goes on from its bag, to the bit."""

import pytest

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.config import settled
from codetr_ros.cores import in_process
from codetr_ros.cores.taking_up import take_up
from helpers.builders import tiny
from helpers.records import content

CASES = {
    'codetr': {},
    'codetr, overlap, two simulators': {'overlap': True, 'simulators': 2},
    'evidence, scores missing': {'method': 'evidence', 'score_missing': 0.2, 'delay': '4:9'},
    'hc': {'method': 'hc'},
    'true': {'method': 'true'},
    'none, not one gradient step': {'method': 'none'},
}


def small(**changes):
    quick = {'steps': 800, 'sac__updates_per_step': 0.1, 'evaluate_every': 300}
    return settled(tiny(**(quick | changes)))


class Ended(BaseException):
    """As if the process had been killed: nothing is closed or saved."""


def killed_after(settings, folder, count):
    """Begin a run and leave it as it is after so many records."""
    seen = []

    def observe(record):
        seen.append(record)
        if len(seen) == count:
            raise Ended

    parts = in_process.Parts(settings, 'run', folder, observe, lambda: None)
    parts.bag = in_process.RunBag(folder / 'bag', settings, '/run_run')
    try:
        parts.announce()
        parts.run()
    except Ended:
        return False
    return True


def records(folder):
    """What a bag holds of everything, told from each other, in any order."""
    return sorted(content(entry.record) for entry in Bag(folder / 'bag').entries())


def compared(report):
    """A report without what depends on the place and the time."""
    left_out = {'cpu_s', 'wall_s', 'peak_rss_mb', 'bag', 'bag_bytes', 'flush_seconds', 'flush_ms'}
    return {name: value for name, value in report.model_dump().items() if name not in left_out}


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory):
    """Reports and folder of an undisturbed run of some settings."""
    known = {}

    def make(case):
        if case not in known:
            folder = tmp_path_factory.mktemp('undisturbed')
            reports = in_process.run(small(**CASES[case]), 'run', folder, bag=True)
            known[case] = reports, folder, len(records(folder))
        return known[case]

    return make


@pytest.mark.parametrize(
    ('case', 'share'),
    [('codetr', 0.0), *zip(CASES, [0.45, 0.6, 0.75, 0.9, 0.97, 0.5], strict=True)],
)
def test_a_run_that_was_ended_anywhere_ends_as_an_undisturbed_one(
    case, share, undisturbed, tmp_path
):
    reports, folder, count = undisturbed(case)
    settings = small(**CASES[case])
    assert not killed_after(settings, tmp_path, max(1, int(share * count)))
    again = take_up(settings, 'run', tmp_path)
    assert {name: compared(r) for name, r in again.items()} == {
        name: compared(r) for name, r in reports.items()
    }
    assert records(tmp_path) == records(folder)
    verdict = verify(tmp_path / 'bag')
    assert verdict.sound, verdict.report()
