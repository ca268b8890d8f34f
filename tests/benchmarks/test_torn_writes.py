"""A run whose files were cut off anywhere goes on: a dense sample of what the script looks at."""

import pytest
import torn_writes

from codetr_ros.cores import in_process


@pytest.mark.slow
def test_bag_and_checkpoints_cut_off_anywhere(tmp_path):
    whole = tmp_path / 'whole'
    whole.mkdir()
    reports = in_process.run(torn_writes.settings(), 'run', whole, bag=True)
    found = torn_writes.torn_bag(whole, tmp_path, 4001)
    assert found['refused'] == {}
    assert set(found['last commit']) >= {'-1', '0', '7'}
    assert all(torn_writes.torn_checkpoints(whole, tmp_path, 401).values())
    assert torn_writes.goes_on(whole, tmp_path, reports['learner'].policy_sha256) == 8
