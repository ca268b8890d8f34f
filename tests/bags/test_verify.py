import os
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.bags.episodes import SourceChecks
from codetr_ros.bags.findings import Findings
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.records import (
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.chain import Chain
from codetr_ros.records.digests import digest
from helpers.bags import WRITERS, a_run, ours
from helpers.builders import policy


def named(path, kind=None):
    """What was found, as text."""
    findings = verify(path).findings
    return [f.text for f in findings.named if kind in (None, f.kind)]


@pytest.mark.parametrize('writer', WRITERS)
def test_a_sound_bag_is_sound_whoever_wrote_it(writer, tmp_path):
    bag = WRITERS[writer](tmp_path / 'bag', a_run())
    missing = [] if (bag / 'metadata.yaml').exists() else ['metadata']
    assert [f.kind for f in verify(bag).findings.named] == missing
    (file,) = [path for path in bag.iterdir() if path.name != 'metadata.yaml']
    assert verify(file).sound


def test_splits_are_compared_as_one_bag(tmp_path):
    bag = ours(tmp_path / 'bag', a_run(phases=40), split_bytes=140_000)
    assert verify(bag).sound
    (bag / 'bag_2.mcap').unlink()
    found = verify(bag)
    assert 'lacks bag_2.mcap' in found.findings.named[0].text
    assert any("transitions of 'sim': numbers" in text for text in named(bag, 'gap'))


def without(records, number, kind):
    """All but one: the so manieth of its kind."""
    gone = [record for record in records if isinstance(record, kind)][number]
    return [record for record in records if record is not gone]


def changed(records, number, kind, **changes):
    old = [record for record in records if isinstance(record, kind)][number]
    return [replace(record, **changes) if record is old else record for record in records]


def bad(array, value=np.nan):
    found = array.copy()
    found.reshape(-1)[1] = value
    return found


RUN = a_run()


CHUNK, SCORE, TRUE = (
    [r for r in RUN if isinstance(r, k)][3] for k in (Transitions, CompositeReward, TrueRewards)
)


LABELS = StepRewards(
    run_id='run',
    phase=0,
    version=5,
    part=0,
    parts=1,
    source='sim',
    episodes=np.array([0], np.uint32),
    first_steps=np.array([0], np.uint32),
    lengths=np.array([5], np.uint32),
    labels=np.ones(5, np.float32),
)


RESULT = EpisodeResult(
    run_id='run',
    source='sim',
    purpose='evaluation',
    step=1,
    version=0,
    episode=0,
    length=5,
    true_return=1.0,
    composite_return=1.0,
    score=float('inf'),
    terminated=False,
)


POLICY = Policy(
    run_id='run',
    phase=1,
    version=0,
    sources=('sim',),
    steps=np.ones(1, np.uint32),
    random=False,
    network='{}',
    weights=b'no tensors',
)


FAULTS = {
    'a chunk is missing': (
        without(RUN, 3, Transitions), 'gap', "transitions of 'sim': number 3 is missing before 4",
    ),
    'a chunk comes twice': (
        [*RUN[:20], CHUNK, *RUN[20:]], 'duplicate', "transitions of 'sim': number 3 comes again",
    ),
    'a score is missing': (
        without(RUN, 3, CompositeReward), 'gap', "composite rewards of 'sim': number 3 is missing",
    ),
    'a segment has no score': (
        without(RUN, 3, CompositeReward), 'segment',
        "the segment of episode 1, steps 0 to 4, has no composite reward",
    ),
    'a segment is scored twice': (
        changed(RUN, 3, CompositeReward, episode=0), 'segment',
        'scores what is no segment of 5 steps, or has its score already',
    ),
    'a score is no number': (
        changed(RUN, 3, CompositeReward, value=np.nan), 'value', 'sequence=3.*not finite',
    ),
    'a score of steps that are not there': (
        changed(RUN, 3, CompositeReward, episode=90), 'segment',
        'steps that the bag does not have',
    ),
    'an observation is no number': (
        changed(RUN, 3, Transitions, observations=bad(CHUNK.observations)), 'value',
        r'sequence=3.*observations\[0, 1\] is nan',
    ),
    'steps do not go on where the last ended': (
        changed(RUN, 1, Transitions, observations=bad(CHUNK.observations, 9.0)), 'value',
        'begins with another observation',
    ),
    'an episode is skipped': (
        changed(RUN, 3, Transitions, episode=2), 'gap', 'episode 2 step 0 where episode 1 step 0',
    ),
    'true rewards of other steps': (
        changed(RUN, 3, TrueRewards, first_step=5), 'record', 'true rewards .* have',
    ),
    'true rewards are missing': (
        without(RUN, 3, TrueRewards), 'record', "transitions 3 of 'sim' have no true rewards",
    ),
    'a true reward is no number': (
        changed(RUN, 3, TrueRewards, rewards=bad(TRUE.rewards)), 'value', 'rewards not finite',
    ),
    'a commit is missing': (
        without(RUN, 1, Commit), 'gap', 'commit of phase 2 where phase 1 is next',
    ),
    'a commit comes twice': (
        [*RUN, RUN[-2]], 'duplicate', 'commit of phase 2 where phase 3 is next',
    ),
    'a commit names what is not there': (
        changed(RUN, 1, Commit, transitions=np.array([9])), 'commit',
        "names transitions 9 of 'sim', the newest before it is 7",
    ),
    'a commit names who is not there': (
        changed(RUN, 1, Commit, sources=('who',)), 'commit', "transitions 7 of 'who'.*is none",
    ),
    'a commit names scores that are not there': (
        changed(RUN, 1, Commit, scores=np.array([9])), 'commit', 'names composite rewards 9',
    ),
    'a commit ends within a phase': (
        changed(RUN, 1, Commit, transitions=np.array([6])), 'commit',
        "ends with transitions 6 of 'sim', the phase itself with 7",
    ),
    'two runs are mixed': (
        [*RUN, *a_run(run_id='other')], 'run', "two runs are mixed in /run: 'run' and 'other'",
    ),
    'the settings are not those of their hash': (
        changed(RUN, 0, RunSpec, settings='{"delay": 5}'), 'run', 'settings have the hash',
    ),
    'another protocol': (changed(RUN, 0, RunSpec, protocol_version=9), 'run', 'protocol 9'),
    'a source that was not announced': (
        without(RUN, 0, TaskSpec), 'run', "'sim' has not announced its task",
    ),
    'commits without the run': (without(RUN, 0, RunSpec), 'run', 'no settings'),
    'labels of no steps': (
        [*RUN, replace(LABELS, episodes=np.array([70], np.uint32))], 'record',
        'labels 1 segments that the bag does not have, the first at episode 70 step 0',
    ),
    'a label is no number': (
        [*RUN, replace(LABELS, labels=bad(LABELS.labels))], 'value', 'labels not finite',
    ),
    'a part of the labels is missing': (
        [*RUN, replace(LABELS, part=1, parts=2)], 'gap', 'where part 0 of phase 0 is next',
    ),
    'a result is no number': ([*RUN, RESULT], 'value', 'score not finite'),
    'weights are no weights': ([*RUN, POLICY], 'value', 'weights cannot be read'),
    'a policy is missing': ([*RUN, POLICY], 'gap', 'policy of phase 1 where that of 0 is next'),
}  # fmt: skip


@pytest.mark.parametrize('fault', FAULTS)
def test_what_is_wrong_is_named(fault, tmp_path):
    records, kind, said = FAULTS[fault]
    found = named(ours(tmp_path / 'bag', records), kind)
    assert any(re.search(said, text) for text in found), found


@pytest.mark.timeout(30)
@pytest.mark.parametrize('field', ['episode', 'first_step', 'phase', 'sequence'])
def test_a_wild_number_takes_neither_time_nor_memory(field, tmp_path):
    wild = changed(RUN, 3, Transitions, **{field: 4_000_000_000})
    assert not verify(ours(tmp_path / 'bag', wild)).sound


def early_commit():
    """The run, with a commit before the last score that it names."""
    at = next(i for i, record in enumerate(RUN) if isinstance(record, Commit))
    return [*RUN[: at - 1], RUN[at], RUN[at - 1], *RUN[at + 1 :]]


def test_our_recorder_writes_a_commit_behind_what_it_names(tmp_path):
    (said,) = named(ours(tmp_path / 'bag', early_commit()), 'commit')
    assert "names composite rewards 3 of 'sim', the newest before it is 2" in said


def test_a_recorder_of_others_may_write_topics_as_they_happen_to_arrive(tmp_path):
    verdict = verify(WRITERS['rosbags-mcap'](tmp_path / 'bag', early_commit()))
    (run,) = verdict.runs.values()
    assert verdict.sound and run.whole == 3
    never = changed(RUN, 1, Commit, transitions=np.array([90]))
    found = named(WRITERS['rosbags-mcap'](tmp_path / 'never', never), 'commit')
    assert any('names transitions 90' in text for text in found)


def test_labels_in_parts_are_sound(tmp_path):
    parts = [replace(LABELS, part=n, parts=2) for n in (0, 1)]
    assert verify(ours(tmp_path / 'bag', [*RUN, *parts, replace(LABELS, phase=2)])).sound


def test_two_runs_in_namespaces_of_their_own_are_not_mixed(tmp_path):
    from codetr_ros.bags.definitions import encode
    from codetr_ros.bags.topics import BagTopic
    from codetr_ros.bags.writer import McapWriter
    from codetr_ros.records import TOPICS
    from codetr_ros.records.fields import type_name

    topics = [
        BagTopic(f'/{n}/{t}', type_name(k), 9, False) for n in 'ab' for k, t in TOPICS.items()
    ]
    writer = McapWriter(tmp_path / 'bag', topics)
    for pair in zip(a_run(run_id='x'), a_run(run_id='y', seed=1), strict=True):
        for name, record in zip('ab', pair, strict=True):
            writer.write(f'/{name}/{TOPICS[type(record)]}', encode(record), 1)
    writer.close()
    verdict = verify(tmp_path / 'bag')
    assert verdict.sound and len(verdict.runs) == 2


def test_scores_that_somebody_gives_later_are_sound(tmp_path):
    records = [replace(r, scorer='me') if isinstance(r, CompositeReward) else r for r in RUN]
    scores = [record for record in records if isinstance(record, CompositeReward)]
    others = [record for record in records if not isinstance(record, (CompositeReward, Commit))]
    assert verify(ours(tmp_path / 'bag', [*others, *scores])).sound


def test_a_bag_of_steps_and_scores_alone_is_sound_and_what_has_no_score_is_said(tmp_path):
    records = [
        r
        for r in without(RUN, 11, CompositeReward)
        if isinstance(r, (Transitions, CompositeReward))
    ]
    verdict = verify(ours(tmp_path / 'bag', records))
    assert verdict.sound
    assert any(
        "5 of 60 steps of 'sim' are in no scored segment" in r for r in verdict.findings.remarks
    )


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def test_a_message_that_is_missing_on_any_topic_is_noticed_by_the_recorders_numbers(tmp_path):
    bag = ours(tmp_path / 'bag', RUN, chunk_bytes=1)
    place = list(Bag(bag).entries([Metrics]))[1].place
    flip(place.file, place.offset + 60)
    assert any('its CRC is' in text for text in named(bag, 'file'))
    assert '/run/metrics: number 1 is missing' in named(bag, 'gap')


@pytest.mark.parametrize(
    ('where', 'said'),
    [
        ('chunk start', 'the chunk states that its messages are from'),
        ('message index', 'the index of channel .* does not agree with its chunk'),
        ('chunk index', 'the index has a chunk at byte .* unlike the file'),
        ('summary', 'the CRC of the summary is'),
        ('library', 'the CRC of everything before is'),
    ],
)
def test_an_index_that_is_wrong_is_named_and_hides_nothing(where, said, tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    path = bag / 'bag_0.mcap'
    data = path.read_bytes()
    chunk = next(Bag(bag).entries()).place.offset
    after = chunk + 9 + int.from_bytes(data[chunk + 1 : chunk + 9], 'little')
    summary = int.from_bytes(data[-28:-20], 'little')
    indexed = data.index(chunk.to_bytes(8, 'little'), summary)
    flip(path, {
        'chunk start': chunk + 9, 'message index': after + 9 + 6 + 3,
        'chunk index': indexed - 16, 'summary': summary + 40, 'library': data.index(b'codetr_ros'),
    }[where])  # fmt: skip
    found = verify(bag).findings
    assert {f.kind for f in found.named} == {'index'}
    assert any(re.search(said, f.text) for f in found.named)
    assert len(list(Bag(bag).entries())) == len(RUN)


@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        ('version: 9', 'version: 12', 'version 12, only 1 to 9 are known'),
        ('message_count: 44', 'message_count: 45', 'counts 45 messages, there are 44'),
        ('storage_identifier: mcap', 'storage_identifier: sqlite3', 'the files are sqlite3'),
        ('/run/commits', '/run/other', '3 messages of /run/other'),
        (
            'rosbag2_bagfile_information',
            'nothing',
            'cannot be read: has no mapping under the key rosbag2_bagfile_information',
        ),
        ('version: 9', 'revision: 9', "cannot be read: there is no 'version'"),
    ],
)
def test_metadata_that_is_not_so_is_named(old, new, said, tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    path = bag / 'metadata.yaml'
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert any(said in text for text in named(bag)), named(bag)


def test_missing_metadata_is_named(tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    (bag / 'metadata.yaml').unlink()
    assert named(bag) == ['metadata.yaml is missing: `ros2 bag` does not open the bag without it']


def test_a_file_that_was_cut_off_is_named_with_the_byte_and_what_is_whole(tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    commits = [entry.place for entry in Bag(bag).entries([Commit])]
    os.truncate(commits[2].file, commits[2].offset)
    verdict = verify(bag)
    assert any('the file ends here, without its index' in f.text for f in verdict.findings.named)
    (run,) = verdict.runs.values()
    assert (run.phases, run.whole) == (2, 2)


def test_what_is_whole_ends_before_what_is_missing(tmp_path):
    verdict = verify(ours(tmp_path / 'bag', without(RUN, 5, Transitions)))
    (run,) = verdict.runs.values()
    assert (run.phases, run.whole) == (3, 1)


def test_a_row_of_a_compressed_database_is_named_as_one(tmp_path):
    bag = WRITERS['rosbags-sqlite-zstd-file'](tmp_path / 'bag', a_run())
    entry = next(Bag(bag).entries())
    assert str(entry.place).endswith('bag.db3.zstd row 1')


@pytest.mark.slow
def test_a_bag_without_true_rewards_and_commits_takes_no_memory_for_each_chunk():
    """A robot's bag: nothing is to be compared with its steps."""
    source = SourceChecks('sim', None, Findings())
    chunk = next(record for record in RUN if isinstance(record, Transitions))

    def send(numbers):
        for n in numbers:
            source.transitions(replace(chunk, sequence=n, first_step=chunk.steps * n), 'place')

    tracemalloc.start()
    try:
        send(range(11_000))
        before = tracemalloc.get_traced_memory()[0]
        send(range(11_000, 25_000))
        assert tracemalloc.get_traced_memory()[0] < 1.2 * before
    finally:
        tracemalloc.stop()


def test_true_rewards_that_come_behind_the_commits_are_no_fault(tmp_path):
    late = sorted(RUN, key=lambda record: isinstance(record, TrueRewards))
    assert verify(ours(tmp_path / 'bag', late)).sound


@pytest.mark.parametrize('phases', [0, 2], ids=['in the first phase', 'behind two phases'])
def test_a_bag_may_end_anywhere_behind_its_last_commit(phases, tmp_path):
    """Topics overtake each other: scores and true rewards may be there, their steps not yet."""
    last = [n for n, each in enumerate(RUN) if isinstance(each, Commit)][phases]
    end = [
        each for each in RUN[:last] if not (isinstance(each, Transitions) and each.phase == phases)
    ]
    verdict = verify(ours(tmp_path / 'bag', end))
    assert verdict.sound, verdict.findings.named
    (run,) = verdict.runs.values()
    assert (run.phases, run.whole) == (phases, phases)
    assert any(
        "scores and true rewards of 'sim' are of steps that" in r for r in verdict.findings.remarks
    )


def test_without_a_run_that_commits_scores_of_no_steps_are_a_fault(tmp_path):
    """A bag that somebody recorded of a robot: nothing says where it may end."""
    own = [r for r in RUN if not isinstance(r, (RunSpec, Commit))]
    lacking = [r for r in own if not (isinstance(r, Transitions) and r.phase == 2)]
    assert 'scores steps that the bag does not have' in ' '.join(
        named(ours(tmp_path / 'bag', lacking))
    )


def proven(records):
    """The same records, with the digests that our recorder states in its commits."""
    chain, out = Chain(1), []
    for record in records:
        if isinstance(record, Commit):
            out.append(chain.completed(record))
            chain.follow(out[-1])
        else:
            chain.note(record)
            out.append(record)
    return out


PERMITTED = [policy(phase=n, sources=('sim',), steps=np.array([20], np.uint32)) for n in range(3)]
LABELLED = replace(LABELS, phase=0)


def with_labels(records):
    """The run with its policies, and with labels behind its first commit."""
    first = next(i for i, r in enumerate(records) if isinstance(r, Commit))
    return [*PERMITTED, *records[: first + 1], LABELLED, *records[first + 1 :]]


PROVEN = proven(with_labels(RUN))
TAMPERED = {
    'a score': (
        3, CompositeReward, {'value': 0.25}, "composite rewards of 'sim' .numbers: 0 to 3",
    ),
    'an observation': (
        4, Transitions, {'actions': bad(CHUNK.actions, 0.5)}, "transitions of 'sim' .numbers: 4",
    ),
    'a label': (0, StepRewards, {'labels': bad(LABELS.labels, 0.5)}, 'the labels of phase 0'),
    'a policy': (1, Policy, {'version': 5}, 'the policy of phase 1'),
    'a commit': (0, Commit, {'policy_digest': 'ab'}, 'the commit of phase 0'),
}  # fmt: skip


@pytest.mark.parametrize('what', TAMPERED)
def test_a_value_that_was_changed_with_its_checksum_is_found_and_named(what, tmp_path):
    """A well-formed lie: the file is whole, and every CRC is right."""
    assert verify(ours(tmp_path / 'sound', PROVEN)).sound
    at, kind, changes, said = TAMPERED[what]
    lie = ours(tmp_path / 'bag', changed(PROVEN, at, kind, **changes))
    found = named(lie, 'digest')
    assert any(re.search(said, text) for text in found), found
    assert set(verify(lie).findings.counts) == {'digest'}


def test_labels_that_claim_another_commit_are_found(tmp_path):
    made_of = next(digest(r) for r in PROVEN if isinstance(r, Commit))
    sound = changed(PROVEN, 0, StepRewards, commit=made_of)
    assert verify(ours(tmp_path / 'sound', sound)).sound
    lie = ours(tmp_path / 'bag', changed(PROVEN, 0, StepRewards, commit='ab' * 32))
    assert any('was made of another commit' in text for text in named(lie, 'digest'))


def test_commits_without_digests_are_no_fault_and_remarked(tmp_path):
    verdict = verify(ours(tmp_path / 'bag', RUN))
    assert verdict.sound
    assert any('3 commits state no digests' in text for text in verdict.findings.remarks)
