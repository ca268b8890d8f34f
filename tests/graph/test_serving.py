"""A fitted model serves in a run over topics, as `ros2 run reward_node reward` starts it."""

import json
from pathlib import Path

import pytest

from codetr_ros import cli
from helpers.builders import tiny
from helpers.nodes import Nodes, Witness, domain
from helpers.runs import train

CHANGES = {
    'task': 'Reacher-v5',
    'steps': 600,
    'sac__updates_per_step': 0.1,
    'evaluate_every': 0,
}


@pytest.fixture(scope='module')
def fitted(tmp_path_factory, ros_domain_of_module) -> Path:
    folder = tmp_path_factory.mktemp('fitted')
    train(tiny(**CHANGES), folder / 'run')
    flags = ['--gradient-steps=20', '--check-every=10', '--out', str(folder / 'fit')]
    assert cli.main(['fit', str(folder / 'run'), *flags]) == 0
    return folder / 'fit'


@pytest.fixture(scope='module')
def ros_domain_of_module():
    with domain():
        yield


@pytest.mark.slow
def test_a_frozen_model_labels_a_run_and_is_what_it_was_at_its_end(fitted, tmp_path):
    settings = tiny(**CHANGES | {'seed': 5})
    with Nodes(settings, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        for name in set(nodes.names) - {'record'}:  # without which the run does not begin
            given = [f'checkpoint:={fitted}', 'frozen:=true'] if name == 'reward' else []
            nodes.start(name, *given)
        witness.until(lambda: 'reward' in witness.presence and witness.presence['reward'].run_id)
        shown = witness.parameters('reward')
        nodes.start('record')
        assert shown['frozen'][0] is True
        assert 'without learning' in shown['frozen'][1].description
        assert shown['checkpoint'][0] == str(fitted)
        assert set(nodes.wait().values()) == {0}
    report = nodes.report('reward')
    digest = json.loads((fitted / 'summary.json').read_text())['reward_model_sha256']
    assert report['reward_model_sha256'] == digest
    assert report['started_from']['frozen'] is True


@pytest.mark.slow
def test_a_model_of_another_delay_is_refused_by_the_node_naming_both(fitted, tmp_path):
    settings = tiny(**CHANGES | {'delay': 9})
    with Nodes(settings, tmp_path / 'run') as nodes:
        for name in nodes.names:
            nodes.start(name, *([f'checkpoint:={fitted}'] if name == 'reward' else []))
        nodes.wait('reward')
        assert nodes.codes()['reward'] == 1
        assert 'has delay = 7, here 9' in nodes.log('reward')
