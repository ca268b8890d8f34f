"""The disk of a run runs full: the run ends, says why, and keeps what it has."""

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from rosbags.highlevel import AnyReader

from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.disks import fill, small_disk
from helpers.nodes import domain
from helpers.runs import finish, start, until, write


def newest_checkpoint(folder):
    """The phase of the newest checkpoint of the reward node; older ones are removed."""
    made = (folder / run_folder.CHECKPOINTS).glob('reward-??????')
    return max((int(path.name.removeprefix('reward-')) for path in made), default=-1)


@pytest.mark.slow
def test_the_run_ends_with_a_whole_bag_and_says_why(tmp_path):
    settings = tiny(steps=10_000_000, memory_steps=10_000, evaluate_every=0)
    with domain(), small_disk(tmp_path / 'disk', 80) as disk:
        folder = disk / 'run'
        command = start(write(settings, tmp_path / 'run'), folder)
        try:
            until(lambda: newest_checkpoint(folder) >= 3, command, folder)
            fill(disk, leave=40_000_000)
            summary, said = finish(command, folder, code=1)
        finally:
            command.kill()
        assert 'codetr: the run failed: record ended with exit code 1' in said
        assert 'fewer than the 64.0 MB to be kept free: make room' in ' '.join(said.split())
        assert 'Traceback' not in said
        assert summary['failure'] == 'record ended with exit code 1'
        with AnyReader([folder / run_folder.BAG]) as bag:
            assert bag.topics[f'/run_{summary["run_id"]}/commits'].msgcount >= 4
            assert len(list(bag.messages())) == bag.message_count
