"""What guards a run is needed: with any of it taken out, the simulation finds a seed that fails.

Each mend is a name, a function that takes it out, and words of the failure by which it is found.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import pytest

from codetr_ros.bags import reopening, writer
from codetr_ros.cores import announced, arrived, held, intake, learner, recorder
from codetr_ros.nodes import (
    behind,
    catching_up,
    fetching,
    keeping,
    ledger,
    outbox,
    patience,
    peers,
    settling,
    sweeping,
    traffic,
)
from codetr_ros.nodes.kept_run import KeptRun
from codetr_ros.records import TOPICS, Policy, StepRewards
from codetr_ros.runs import checkpoints
from codetr_ros.simtest import disks, process
from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.losing import losing
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.plan import Death, all_settings, names_of, plan
from codetr_ros.simtest.run import carry_out, undisturbed
from helpers.deaths import deadly
from helpers.slow_runs import far_apart, slow_and_losing

MOST = 150
"""Seeds that are tried."""


def accept_duplicates(patch):
    def taken(self, record, due, name):
        due[name] = max(due[name], record.sequence + 1)
        return True

    patch.setattr(arrived.Arrived, '_next', taken)


def accept_gaps(patch):
    def taken(self, record, due, name):
        if record.sequence < due[name]:
            self._duplicated[TOPICS[type(record)]] += 1
            return False
        due[name] = record.sequence + 1
        return True

    patch.setattr(arrived.Arrived, '_next', taken)
    patch.setattr(recorder.Recorder, 'comes_early', lambda self, record: False)


def count_nothing_twice(patch):
    def add(self, record, in_doubt):
        real(self, record, in_doubt)
        return True

    real = held.Held.add
    patch.setattr(held.Held, 'add', add)


def take_in_in_another_order(patch):
    real = held.Held.named
    patch.setattr(held.Held, 'named', lambda self, *given: real(self, *given)[::-1])


def train_before_the_commit(patch):
    def take(self, phase, memory):
        if phase not in self._commits and self._transitions:
            for key in sorted(self._transitions):
                if self._transitions[key].phase == phase:
                    memory.append(self._transitions.pop(key))
        return real(self, phase, memory)

    real = intake.Intake.take
    patch.setattr(intake.Intake, 'take', take)


def commit_without_scores(patch):
    def whole(self, phase):
        there = self._arrived
        scores, far = there._scores, Counter(dict.fromkeys(there._scores, 10**6))
        there._scores = there._committed_scores + far
        try:
            return real(self, phase)
        finally:
            there._scores = scores

    real = recorder.Recorder._whole
    patch.setattr(recorder.Recorder, '_whole', whole)


def commit_half_a_phase(patch):
    def whole(self, phase):
        members = self._permitted.get(phase)
        return bool(members) and any((phase, source) in self._arrived._ended for source in members)

    patch.setattr(recorder.Recorder, '_whole', whole)


def flush_without_syncing(patch):
    patch.setattr(writer.McapWriter, 'flush', lambda self: self._stream.flush())


def sync_without_ending_the_chunk(patch):
    patch.setattr(writer.McapWriter, 'flush', lambda self: self._disk.sync(self._stream))


def leave_half_a_chunk(patch):
    patch.setattr(writer.os, 'truncate', lambda path, size: None)


def never_fetch_again(patch):
    patch.setattr(fetching.Fetching, 'due', lambda self, missing, now, at_once=False: False)


def forget_the_last_phases(patch):
    patch.setattr(KeptRun, 'read', lambda self, phase, kinds=(): ())


def count_strangers(patch):
    def decode(self, kind, data, again=None):
        self.run_id = ''  # any
        return real(self, kind, data, again)

    real = traffic.Traffic.decode
    patch.setattr(traffic.Traffic, 'decode', decode)


def forget_who_has_ended(patch):
    def note(self, presence, now):
        self.by_instance.pop(presence.instance_id, None)
        return real(self, presence, now)

    real = peers.Peers.note
    patch.setattr(peers.Peers, 'note', note)


def commit_before_counting_the_phase(patch):
    def commit(self, phase, recorded=None):
        made = real(self, phase, recorded)
        self.phase = phase
        return made

    def work(self):
        for out in whole(self):
            yield out
            self.phase += out is not None

    real, whole = recorder.Recorder._commit, recorder.Recorder.work
    patch.setattr(recorder.Recorder, '_commit', commit)
    patch.setattr(recorder.Recorder, 'work', work)


def compare_no_digests(patch):
    def named(self, name, last, digest):
        return replace(real(self, name, last, digest), difference='')

    real = held.Held._named
    patch.setattr(held.Held, '_named', named)


def judge_before_records_were_in_doubt(patch):
    patch.setattr(intake.Intake, 'fetched', lambda self, phase: setattr(self, '_fetched', phase))


def never_give_up(patch):
    patch.setattr(patience.Patience, 'check', lambda self, *given: None)


def wait_with_all_others(patch):
    patch.setattr(patience.Patience, '_check_endless', lambda self, now, mine: None)


def give_up_on_what_is_still_to_come(patch):
    patch.setattr(fetching.Fetching, 'to_come', lambda self, now: None)


def keep_no_phase_between_others(patch):
    def read(self, phase, kinds=()):
        if phase not in self._phases:
            raise KeyError(f'nothing of phase {phase} is kept')
        return real(self, phase, kinds)

    real = outbox.Outbox.read
    patch.setattr(outbox.Outbox, 'read', read)


def end_before_all_is_there(patch):
    patch.setattr(settling.Settling, 'check', lambda self, missing, seconds, now: (True, ''))


def take_labels_again(patch):
    patch.setattr(
        learner.Learner,
        '_applied',
        property(lambda self: 0, lambda self, value: None),
        raising=False,
    )


def believe_strangers(patch):
    for module in (announced, intake, recorder, learner):
        patch.setattr(module, 'check_run', lambda record, run: None)


def never_ask(*names):
    """Takes questions of a node out."""

    def take_out(patch):
        for name in names:
            patch.setattr(catching_up.Fetcher, name, lambda self, *given: None)

    return take_out


def never_ask_for_announcements(patch):
    never_ask('_ask_sources')(patch)


def never_ask_for_commits(patch):
    never_ask('_ask_commit')(patch)


def never_ask_for_labels(patch):
    never_ask('_ask_reward')(patch)


def never_ask_for_policies(patch):
    never_ask('_ask_learner')(patch)


def never_sweep(patch):
    patch.setattr(sweeping.Sweeper, 'ask', lambda self, nodes, lacking=False: None)


def keep_policies_and_labels_in_any_order(patch):
    def place(self, record):
        return None if isinstance(record, (Policy, StepRewards)) else real(self, record)

    real = recorder.Recorder._place
    patch.setattr(recorder.Recorder, '_place', place)


def forget_early_records(patch):
    patch.setattr(ledger.Ledger, 'set_aside', lambda self, record: None)
    patch.setattr(recorder.Recorder, 'still_due', lambda self, record: False)


def count_what_was_late_twice(patch):
    def arrived(self, record, sender, stamp):
        if sender:
            self._account(sender).again.clear()
        real(self, record, sender, stamp)

    real = ledger.Ledger.arrived
    patch.setattr(ledger.Ledger, 'arrived', arrived)


def leave_the_bag_of_a_killed_recorder_as_it_is(patch):
    patch.setattr(reopening, 'mend', lambda folder, disk: None)


def ask_nobody_what_a_killed_recorder_has_missed(patch):
    patch.setattr(keeping.Keeping, 'go_on', lambda self: self._traffic.ledger.forgive())


def begin_from_the_start(patch):
    patch.setattr(process, 'go_on', lambda node: (each for each in ()))


def go_on_from_a_torn_checkpoint(patch):
    def sound(folder, name, newest=None, log=None):
        for path in reversed(checkpoints.every(folder, name)):
            tensors, meta = checkpoints.load(path)
            yield checkpoints.Checkpoint(path, checkpoints.phase_of(path), tensors, meta)

    patch.setattr(checkpoints, 'sound', sound)


def name_a_checkpoint_before_it_is_on_the_disk(patch):
    def write(self, path, data):
        with self.create(path) as file:
            file.write(data)

    patch.setattr(disks.TroubledDisk, 'write', write)


def end_before_what_was_missed_is_there(patch):
    def go_on(self):
        real(self)
        self._missed_until = 0.0

    real = keeping.Keeping.go_on
    patch.setattr(keeping.Keeping, 'go_on', go_on)


def go_on_for_nobody(patch):
    def over(self, peers):
        return self._core.lacks_permission and real(self, peers)

    real = behind.Behind.over
    patch.setattr(behind.Behind, 'over', over)


def forget_what_was_published(patch):
    def read(self, phase, kinds=()):
        raise KeyError(f'phase {phase} is not kept')

    patch.setattr(outbox.Outbox, 'read', read)


MENDS: dict[Callable, str] = {
    accept_duplicates: 'other weights|not sound|are whole|gave up|stuck',
    accept_gaps: 'not sound|are whole|other weights',
    count_nothing_twice: 'repeated messages',
    take_in_in_another_order: 'other weights|gave up',
    train_before_the_commit: 'other weights|fault|gave up',
    commit_without_scores: 'cannot be learnt from again|not sound|are whole|gave up|stuck',
    commit_half_a_phase: 'cannot be learnt from again|not sound|are whole|gave up|fault|stuck',
    flush_without_syncing: 'before it is on the disk',
    sync_without_ending_the_chunk: 'before it is on the disk',
    leave_half_a_chunk: 'not sound: file',
    never_fetch_again: 'gave up',
    forget_the_last_phases: 'gave up',
    count_strangers: 'were published on|not sound',
    forget_who_has_ended: 'gave up|stuck|stays for|were published on',
    commit_before_counting_the_phase: 'were published on|not sound|gave up',
    compare_no_digests: 'other weights|fault',
    judge_before_records_were_in_doubt: 'gave up',
    never_give_up: 'stuck',
    wait_with_all_others: 'stuck',
    give_up_on_what_is_still_to_come: 'gave up',
    keep_no_phase_between_others: 'gave up',
    end_before_all_is_there: 'were published on|names no cause|not sound',
    take_labels_again: 'repeated messages',
    believe_strangers: 'other weights|not sound|gave up|fault',
    never_ask_for_announcements: 'gave up',
    never_ask_for_commits: 'gave up',
    never_ask_for_labels: 'gave up',
    never_ask_for_policies: 'gave up',
    never_sweep: 'gave up',
    keep_policies_and_labels_in_any_order: 'not sound',
    forget_early_records: 'not sound|were published on|gave up',
    count_what_was_late_twice: 'not sound|were published on',
    leave_the_bag_of_a_killed_recorder_as_it_is: 'not sound|gave up|cannot be read|fault',
    ask_nobody_what_a_killed_recorder_has_missed: 'not sound|gave up',
    begin_from_the_start: 'gave up|other weights|stuck|not sound|fault',
    go_on_from_a_torn_checkpoint: 'gave up',
    forget_what_was_published: 'gave up|not sound',
    end_before_what_was_missed_is_there: 'gave up|not sound',
    name_a_checkpoint_before_it_is_on_the_disk: 'has damaged a checkpoint',
    go_on_for_nobody: 'stays for',
}


def overrun(planned):
    """The same run, but that some of what is published never reaches the recorder."""
    return replace(planned, weather=replace(planned.weather, overrun=0.05))


def unanswered(planned):
    """The same run, but that some never reaches the recorder, and nobody answers."""
    weather = replace(planned.weather, overrun=0.05, unanswered=1.0)
    return replace(planned, weather=weather, heals=False)


def lossy(planned):
    """The same run, but that many messages are lost, and nothing else goes wrong."""
    planned = replace(planned, weather=Weather(delay=0.02, lost=0.3, overrun=0.1), deaths=())
    return replace(planned, disk=Trouble(), checkpoints=Trouble(), leave_out_after=0.0)


def overtaken(planned):
    """A run in which what a node has published last is overtaken by seconds, and nothing else."""
    return far_apart(plan(5 + planned.seed))


def cut_off(planned):
    """The same run, but that whoever saves a checkpoint is killed, and its machine cut off."""
    return replace(
        planned, checkpoints=Trouble(kills_in=planned.seed % 16, power=True), disk=Trouble()
    )


def killed_at_the_end(planned):
    """The same run, but that its recorder is killed late."""
    deaths = (Death('record', 2.5 + planned.seed % 16, 6.0),)
    paces = dict.fromkeys(planned.paces, Pace(slice_seconds=0.2))
    planned = replace(planned, paces=paces, weather=Weather(delay=0.3), disk=Trouble())
    return replace(planned, deaths=deaths, checkpoints=Trouble(), heals=True)


def killed_late(planned):
    """A longer run whose learner and simulator are killed when nobody but the recorder keeps its
    first phases any more.
    """
    planned = lossy(planned)
    deaths = tuple(Death(name, 14.0 + planned.seed % 16, 1.0) for name in ('learner', 'sim'))
    paces = dict.fromkeys(planned.paces, Pace(slice_seconds=0.2))
    settings = planned.settings.changed({'steps': 96})
    weather = Weather(delay=0.02)
    planned = replace(planned, settings=settings, paces=paces, weather=weather)
    return replace(planned, deaths=deaths, heals=True)


def slow_and_lossy(planned):
    """The same run, but that many messages never reach the recorder, and all take their time."""
    planned = lossy(planned)
    return replace(planned, weather=Weather(delay=0.5, overrun=0.2))


def much_lost(planned):
    """A run that loses a fifth of everything, some of whose nodes are killed."""
    return losing(61 + planned.seed)  # so few fail


def left_behind(planned):
    """The same run, one of whose simulators is so slow that it is left out."""
    settings = all_settings()[5]
    paces = {name: Pace() for name in names_of(settings)} | {'sim_2': Pace(slice_seconds=4.0)}
    return replace(lossy(planned), settings=settings, paces=paces, leave_out_after=2.0)


def crowded(planned):
    """The same run, but that some never reaches the recorder, and strangers publish a lot."""
    return replace(planned, weather=replace(planned.weather, overrun=0.05, strangers=0.3))


PLANS = {
    count_strangers: crowded,
    forget_who_has_ended: overtaken,
    accept_gaps: lambda planned: overrun(plan(5 + planned.seed)),
    wait_with_all_others: unanswered,
    give_up_on_what_is_still_to_come: lambda planned: slow_and_losing(planned.seed),
    keep_no_phase_between_others: much_lost,
    never_ask_for_announcements: lossy,
    never_ask_for_commits: lossy,
    never_ask_for_labels: lossy,
    never_ask_for_policies: lossy,
    never_sweep: lossy,
    keep_policies_and_labels_in_any_order: lossy,
    forget_early_records: slow_and_lossy,
    count_what_was_late_twice: slow_and_lossy,
    leave_the_bag_of_a_killed_recorder_as_it_is: deadly,
    ask_nobody_what_a_killed_recorder_has_missed: deadly,
    begin_from_the_start: killed_late,
    go_on_from_a_torn_checkpoint: deadly,
    forget_what_was_published: deadly,
    end_before_what_was_missed_is_there: killed_at_the_end,
    name_a_checkpoint_before_it_is_on_the_disk: cut_off,
    go_on_for_nobody: left_behind,
}
"""What is rare among the seeds is planned."""


@pytest.fixture(autouse=True)
def references():
    """What runs are compared with, from before anything is taken out."""
    for settings in all_settings():
        undisturbed(settings.canonical())


@pytest.mark.slow
@pytest.mark.parametrize('take_out', MENDS, ids=lambda mend: mend.__name__)
def test_what_is_taken_out_is_found_missing_by_a_seed(take_out, monkeypatch):
    planned = PLANS.get(take_out, lambda each: each)
    with monkeypatch.context() as patch:
        take_out(patch)
        outcomes = (carry_out(planned(plan(seed))) for seed in range(MOST))
        found = next((outcome for outcome in outcomes if outcome.failures), None)
    assert found is not None, f'no seed below {MOST} fails'
    words = MENDS[take_out].split('|')
    assert any(word in found.failures[0] for word in words), found.failures
    assert not carry_out(found.plan).failures  # the mend mends it


def few_reach_the_recorder(planned):
    """The same run, but that some of what is published never reaches the recorder, and nothing
    else goes wrong.
    """
    return replace(lossy(planned), weather=Weather(delay=0.02, overrun=0.1))


def test_what_no_count_shows_is_asked_for_once_nobody_works(monkeypatch):
    """No planned death hides a loss from the counts: none is looked at here."""
    monkeypatch.setattr(ledger.Ledger, 'lost', lambda self, now: {})
    seeds = range(11)
    assert all(carry_out(few_reach_the_recorder(plan(seed))).failures == [] for seed in seeds)
    monkeypatch.setattr(keeping.Keeping, '_nobody_works', lambda self: False)
    assert any(
        failure.startswith('gave up')
        for seed in seeds
        for failure in carry_out(few_reach_the_recorder(plan(seed))).failures
    )
