"""A run in process that was ended at any moment goes on from its bag, to the bit."""

import shutil

import pytest

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.config import settled
from codetr_ros.cores import in_process
from codetr_ros.cores.preparing import for_nodes
from codetr_ros.cores.taking_up import take_up
from codetr_ros.runs import checkpoints
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
    [
        ('codetr', 0.0),
        # labels lie between the last commit and the one that will name them
        ('codetr, overlap, two simulators', 0.85),
        *zip(CASES, [0.45, 0.6, 0.75, 0.9, 0.97, 0.5], strict=True),
    ],
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


@pytest.mark.parametrize('steps', [600, 500, 400, 150])
def test_a_finished_run_goes_on_as_if_it_had_been_longer_from_the_start(
    steps, undisturbed, tmp_path, caplog
):
    """600 ends with a phase, 500 and 150 within one, 400 with the warm-up."""
    reports, folder, _ = undisturbed('codetr')
    settings = small(**CASES['codetr'])
    in_process.run(settings.changed({'steps': steps}), 'run', tmp_path, bag=True)
    again = take_up(settings, 'run', tmp_path)
    assert again['learner'].policy_sha256 == reports['learner'].policy_sha256
    assert {name: compared(r) for name, r in again.items()} == {
        name: compared(r) for name, r in reports.items()
    }
    assert records(tmp_path) == records(folder)
    assert verify(tmp_path / 'bag').sound
    assert ('is done again' in caplog.text) == bool(steps % 200)


@pytest.fixture
def halfway(undisturbed, tmp_path):
    """A run that was ended behind its second half, and what it is to end as."""
    reports, _, count = undisturbed('codetr')
    settings = small(**CASES['codetr'])
    killed_after(settings, tmp_path, int(0.8 * count))
    return settings, tmp_path, reports['learner'].policy_sha256


@pytest.mark.parametrize('newest', ['learner', 'reward'])
def test_the_checkpoint_before_a_damaged_one_is_taken(newest, halfway, caplog):
    settings, folder, digest = halfway
    path = sorted((folder / 'checkpoints').glob(f'{newest}-*'))[-1] / checkpoints.TENSORS
    path.write_bytes(path.read_bytes()[:-5])
    assert take_up(settings, 'run', folder)['learner'].policy_sha256 == digest


def test_without_checkpoints_all_is_learnt_again_from_the_bag(halfway, caplog):
    settings, folder, digest = halfway
    shutil.rmtree(folder / 'checkpoints')
    assert take_up(settings, 'run', folder)['learner'].policy_sha256 == digest
    assert 'all phases are learnt from again' in caplog.text


@pytest.mark.parametrize(
    ('share', 'where'),
    [(0.8, 'the bag ends with the commit of phase'), (0.1, 'no phase was committed')],
)
def test_a_bag_cut_anywhere_gives_the_same_weights(share, where, halfway, caplog):
    settings, folder, digest = halfway
    bag = folder / 'bag' / 'bag_0.mcap'
    whole = bag.read_bytes()
    bag.write_bytes(whole[: int(share * len(whole))])
    assert take_up(settings, 'run', folder)['learner'].policy_sha256 == digest
    assert where in caplog.text


def test_a_bag_with_other_settings_or_of_another_run_is_refused_unchanged(halfway):
    settings, folder, _ = halfway
    before = {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}
    with pytest.raises(BagError, match='is of a run with seed = 0 .here 3.*only steps may change'):
        take_up(settings.changed({'seed': 3}), 'run', folder)
    with pytest.raises(BagError, match="holds run 'run', not 'other'"):
        take_up(settings, 'other', folder)
    assert before == {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


def test_a_bag_that_is_damaged_before_its_last_commit_is_refused(halfway):
    settings, folder, _ = halfway
    bag = folder / 'bag' / 'bag_0.mcap'
    content = bytearray(bag.read_bytes())
    content[len(content) // 2] ^= 1
    bag.write_bytes(content)
    with pytest.raises(BagError, match='a commit lies behind it'):
        take_up(settings, 'run', folder)


def test_a_run_whose_bag_is_gone_is_not_begun_anew_beside_its_checkpoints(halfway):
    settings, folder, _ = halfway
    shutil.rmtree(folder / 'bag')
    for go_on in (take_up, for_nodes):
        with pytest.raises(BagError, match='there is no bag .* Restore it from a copy, or start'):
            go_on(settings, 'run', folder)
    assert list((folder / 'checkpoints').iterdir())


def test_checkpoints_that_fit_no_bag_or_no_learner_are_removed_before_nodes_go_on(halfway, caplog):
    settings, folder, _ = halfway
    where = folder / 'checkpoints'
    newest = checkpoints.latest(where, 'learner')
    learnt = checkpoints.phase_of(newest)
    for phase in (learnt + 1, learnt + 2):
        shutil.copytree(newest, where / f'reward-{phase:06}')
    for_nodes(settings, 'run', folder)
    assert checkpoints.latest(where, 'learner') == newest
    kept = checkpoints.phase_of(checkpoints.latest(where, 'reward'))
    assert kept == learnt + 1, 'the labels of this phase are published again'
    assert f'the learner goes on from phase {learnt}, and needs all labels since' in caplog.text

    (bag,) = (folder / 'bag').glob('*.mcap')
    sound = bag.read_bytes()
    bag.write_bytes(sound[:9000] + b'\xff' * 8 + sound[9008:])
    with pytest.raises(BagError, match='a commit lies behind it'):
        for_nodes(settings, 'run', folder)
    assert checkpoints.latest(where, 'learner') == newest

    bag.write_bytes(sound[:3000])
    (folder / 'bag' / 'metadata.yaml').touch()  # the recorder would take it for another bag's
    for_nodes(settings, 'run', folder)
    assert list(where.iterdir()) == list((folder / 'bag').iterdir()) == []
    assert 'no phase was committed: the run begins from its start' in caplog.text
