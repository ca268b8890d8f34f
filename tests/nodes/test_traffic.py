"""Messages are counted where they arrive: of this run, sound or not."""

import logging
from dataclasses import replace

from codetr_ros.bags.definitions import encode
from codetr_ros.config import settled
from codetr_ros.cores import in_process
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import Transitions
from helpers.builders import score, step_rewards, tiny, transitions


def test_what_is_of_another_run_does_not_stand_in_for_what_is_lost_of_this_one():
    traffic = Traffic(logging.getLogger(__name__))
    traffic.run_id = 'run'
    for record in (transitions(), replace(transitions(), run_id='another')):
        assert traffic.decode(Transitions, encode(record)) is not None
    assert traffic.decode(Transitions, b'junk') is None
    assert traffic.received == {'transitions': 2}  # one sound, one not
    assert traffic.refused == {'transitions': 1}


def test_what_a_node_fetches_again_once_it_has_joined_was_not_taken_before():
    settings = tiny()
    traffic = Traffic(logging.getLogger(__name__))
    core = Labeller(settings.run_spec('run'), settings, 'reward', None)
    traffic.core, traffic.settings = core, settings
    traffic.hold()
    for record in (transitions(), score()):
        assert traffic.receive(record)
    traffic.release(later=lambda record: True)
    for record in (transitions(), score()):
        traffic.receive_again(record)
    assert core.duplicated == {}
    assert traffic.recovered == {'transitions': 1, 'composite_rewards': 1}


def test_labels_of_phases_that_a_learner_goes_on_behind_are_taken(tmp_path):
    """It has their checkpoint already, and takes in the phases before from the first on."""
    settings = settled(tiny(method='none', evaluate_every=0, sac__updates_per_step=0.01))
    in_process.run(settings, 'run', tmp_path)
    traffic = Traffic(logging.getLogger(__name__))
    core = Learner(settings.run_spec('run'), settings, 'learner', tmp_path / 'checkpoints')
    traffic.core, traffic.settings = core, settings
    phase = core.resume(settings.phases - 2)
    for of in (phase, phase + 1):
        assert traffic.receive(step_rewards(phase=of))
    assert not traffic.refused
    assert core.due == 0
    traffic.receive(step_rewards(phase=phase + settings.lag + 1))
    assert traffic.refused == {'step_rewards': 1}
