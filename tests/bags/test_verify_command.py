"""The command `codetr bag verify`."""

import json
from dataclasses import replace

import numpy as np

from codetr_ros.cli import main
from codetr_ros.records import (
    CompositeReward,
)
from helpers.bags import a_run, ours


def test_the_command_says_so_by_its_exit_code(tmp_path, capsys):
    bag = ours(tmp_path / 'bag', a_run())
    assert main(['bag', 'verify', str(bag)]) == 0
    said = capsys.readouterr().out
    assert 'sound' in said and '3 phases committed, all whole' in said
    assert main(['bag', 'verify', str(bag), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['sound'] is True
    (bag / 'metadata.yaml').unlink()
    assert main(['bag', 'verify', str(bag)]) == 1
    assert 'codetr bag recover' in capsys.readouterr().out
    assert main(['bag', 'verify', str(tmp_path / 'none')]) == 2


def test_recover_is_advised_only_where_it_can_mend_something(tmp_path, capsys):
    """What it made from a bag with gaps still has the gaps."""
    whole = a_run()
    lost = next(i for i, r in enumerate(whole) if isinstance(r, CompositeReward))
    bag, new = ours(tmp_path / 'bag', whole[:lost] + whole[lost + 1 :]), tmp_path / 'new'
    (bag / 'metadata.yaml').unlink()
    main(['bag', 'verify', str(bag)])
    assert 'codetr bag recover' in capsys.readouterr().out
    assert main(['bag', 'recover', str(bag), '--out', str(new)]) == 1
    capsys.readouterr()
    assert main(['bag', 'verify', str(new)]) == 1
    said = capsys.readouterr().out
    assert '--out NEW' not in said and 'has nothing to mend' in said


def test_findings_that_are_not_printed_are_counted(tmp_path, capsys):
    """Of each kind a thousand are named."""
    records = a_run(phases=300, chunk=1)[1:]  # no segments without the run's settings
    broken = [replace(r, value=np.nan) if isinstance(r, CompositeReward) else r for r in records]
    bag = ours(tmp_path / 'bag', broken)
    count = sum(isinstance(r, CompositeReward) for r in records)
    assert main(['bag', 'verify', str(bag), '--limit', '5000']) == 1
    said = capsys.readouterr().out
    assert said.count('value: ') - said.count('value: 5') == 1000, said[-300:]
    assert f'value: {count - 1000} more' in said
