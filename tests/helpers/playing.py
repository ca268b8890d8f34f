"""Nodes as processes, and peers that a test plays itself over real topics."""

import os
import time
from contextlib import contextmanager

import numpy as np

from codetr_ros.bags.definitions import decode
from codetr_ros.records import TOPICS, Presence, RunSpec
from codetr_ros.records.roles import published_by, readers
from codetr_ros.ros.link import Link
from helpers.builders import policy, score, task_spec, transitions
from helpers.forked import Forked

MODULES = {
    'record': 'codetr_ros.ros.record',
    'sim': 'sim_node.sim',
    'learner': 'learner_node.learner',
    'reward': 'reward_node.reward',
    'score': 'codetr_ros.ros.score',
    'deaf': 'helpers.deaf',
    'uncommitted': 'helpers.deaf:uncommitted',
    'unannounced': 'helpers.deaf:unannounced',
    'unpermitted': 'helpers.deaf:unpermitted',
    'imports': 'helpers.slow_import',
    'compiles': 'helpers.slow_import:compiling',
}
NAMESPACE = '/r'
PATIENCE = 180.0  # discovery and imports on a busy machine


@contextmanager
def process(role: str, *parameters: str, name: str | None = None):
    """A node of this role in the namespace of the test; killed at the end if it has not ended."""
    command = [role, '--ros-args', '-r', f'__ns:={NAMESPACE}']
    command += ['-r', f'__node:={name}'] if name else []
    for parameter in parameters:
        command += ['-p', parameter]
    module, _, function = MODULES[role].partition(':')
    node = Forked(command, os.environ, function=f'{module}:{function or "main"}')
    try:
        yield node
    finally:
        if node.poll() is None:
            node.kill()
        node.communicate()


def output(node: Forked) -> str:
    return node.communicate(timeout=PATIENCE)[0]


class Play:
    """Peers played by the test: they say that they are there and publish what they are told to."""

    def __init__(self, settings, roles=('learner', 'sim', 'reward'), run_id='run'):
        self.settings = settings
        self.spec = settings.run_spec(run_id)
        self.heard = []
        self.links = {role: Link(role) for role in roles}
        for role, link in self.links.items():
            link.advertise(['presence', *published_by(role)], settings)
            for kind in TOPICS:
                if role in readers().get(TOPICS[kind], ()) or kind in (Presence, RunSpec):
                    link.subscribe(
                        kind,
                        lambda kind, data, role=role: self.heard.append(
                            (role, decode(kind, data))
                        ),
                        settings,
                    )
        self.finished = False
        self.claimed = {}
        if 'learner' in roles:
            self.links['learner'].publish(self.spec)

    def say(self):
        for role, link in self.links.items():
            link.publish(self.presence_now(role))

    def presence_now(self, role):
        link, topics = self.links[role], published_by(role)
        counts = [link.published[t] + self.claimed.get(t, 0) for t in topics]
        return Presence(
            run_id=self.spec.run_id,
            role=role,
            node=link.full_name,
            instance_id=link.instance,
            settings_hash=self.spec.settings_hash,
            finished=self.finished,
            topics=topics,
            published=np.array(counts, np.uint64),
            missed=0,
        )

    def until(self, found, node=None):
        """Spin, saying presence, until `found()` is true; returns what it returns."""
        end, said = time.monotonic() + PATIENCE, 0.0
        while time.monotonic() < end:
            assert node is None or node.poll() is None, output(node)
            if time.monotonic() - said > 0.3:
                said = time.monotonic()
                self.say()
            for link in self.links.values():
                link.drain(0.01)
                while link.inbox:
                    link.inbox.popleft()()
            if result := found():
                return result
        raise AssertionError(
            f'not within {PATIENCE} s; heard {[type(m).__name__ for _, m in self.heard][-20:]}'
        )

    def messages(self, kind, role=None):
        return [m for r, m in self.heard if type(m).__name__ == kind and role in (None, r)]

    def presence_of(self, role):
        return [
            m
            for m in self.messages('Presence')
            if m.role == role and 'of the test' not in m.instance_id
        ]

    def close(self):
        for link in self.links.values():
            link.close()


def one_phase(play):
    """What a run of one phase of five steps publishes, up to its commit."""
    sim, learner = play.links['sim'], play.links['learner']
    sim.publish(task_spec())
    learner.publish(policy(steps=np.array([5], np.uint32)))
    sim.publish(transitions(phase_end=True, scores_due=1))
    sim.publish(score(length=5))
    return play.until(lambda: play.messages('Commit', 'learner'))[0]


def everybody_matched(play):
    """Whether the recorder reads what the test publishes."""
    return not play.links['sim'].unmatched(
        ['transitions', 'composite_rewards', 'task'],
        lambda _: {f'{NAMESPACE}/record'},
        readers=True,
    ) and not play.links['reward'].unmatched(
        ['step_rewards'], lambda _: {f'{NAMESPACE}/record'}, readers=True
    )
