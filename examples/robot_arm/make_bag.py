"""Records a bag as a robot's own software might: no topic in it is this project's.

    .venv/bin/python examples/robot_arm/make_bag.py /tmp/arm_bag

A made-up arm of two joints gets a velocity command about ten times a second, reports its joints
fifty times a second, and is scored every two seconds: how near was its hand to the target? Each
attempt lasts eight seconds and ends with a message. Times jitter, as they do.

With `--verdicts` a person also judges each attempt as a whole. That takes four to eight seconds,
and the next attempt begins after three. Every fifth verdict is corrected a second later.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from arm import FASTEST, nearness
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

NS = 10**9
BEGIN = 1_700_000_000 * NS  # when the recording begins
SECONDS = 8.0  # of an attempt
PAUSE = 3.0  # [s] between two attempts


def attempt(rng: np.random.Generator, begin: int) -> Iterator[tuple[int, str, Any]]:
    """Time [ns], topic and value of everything in one attempt."""
    joints, speed = rng.uniform(-1.5, 1.5, 2), np.zeros(2)
    command, toward = np.zeros(2), rng.uniform(-1, 1, 2)
    near: list[float] = []
    for tick in range(round(SECONDS * 50)):
        now = begin + round((tick + rng.uniform(0, 0.2)) * NS / 50)
        yield now, '/joint_states', (joints.copy(), speed.copy())
        if tick % 5 == 0:  # the controller wanders about, now and then in another direction
            toward = rng.uniform(-1, 1, 2) if rng.random() < 0.2 else toward
            command = np.clip(toward + 0.3 * rng.normal(size=2), -1, 1) * FASTEST
            yield now + 2_000_000, '/arm/velocity_commands', command
        speed += 0.5 * (command - speed)
        joints = joints + speed / 50
        near.append(float(nearness(joints)))
        if tick % 100 == 99:
            yield now + 4_000_000, '/judge/score', 20 * float(np.mean(near))
            near.clear()
    yield begin + round(SECONDS * NS), '/arm/attempt_ended', None


def verdicts(rng: np.random.Generator, number: int, begin: int) -> Iterator[tuple[int, str, Any]]:
    """Time [ns], topic and value of the verdict on an attempt, and of its correction."""
    now = begin + round((SECONDS + rng.uniform(4, 8)) * NS)
    grade = float(rng.integers(1, 6))
    if number % 5 == 4:
        yield now, '/judge/verdict', -grade  # a slip of the finger
        now += NS
    yield now, '/judge/verdict', grade


def message(store: Any, topic: str, value: Any, now: int) -> Any:
    """The message that a topic carries."""
    types = store.types
    if topic == '/joint_states':
        position, velocity = value
        stamp = types['builtin_interfaces/msg/Time'](*divmod(now, NS))
        header = types['std_msgs/msg/Header'](stamp, 'base')
        # the gripper is none of our business, and comes between the two joints that are
        return types['sensor_msgs/msg/JointState'](
            header,
            ['elbow', 'gripper', 'shoulder'],
            np.array([position[1], 0.02, position[0]]),
            np.array([velocity[1], 0.0, velocity[0]]),
            np.empty(0),
        )
    if topic == '/arm/velocity_commands':
        layout = types['std_msgs/msg/MultiArrayLayout']([], 0)
        return types['std_msgs/msg/Float64MultiArray'](layout, value)
    if topic in ('/judge/score', '/judge/verdict'):
        return types['std_msgs/msg/Float64'](value)
    return types['std_msgs/msg/Empty'](0)


def write(
    folder: Path,
    attempts: int = 30,
    seed: int = 0,
    storage: StoragePlugin = StoragePlugin.MCAP,
    judged: bool = False,
) -> None:
    """Write the bag; `judged` adds the verdicts."""
    rng, store = np.random.default_rng(seed), get_typestore(Stores.ROS2_JAZZY)
    person = np.random.default_rng([seed, 1])
    messages = []
    for n in range(attempts):
        begin = BEGIN + round(n * (SECONDS + PAUSE) * NS)
        messages += attempt(rng, begin)
        messages += verdicts(person, n, begin) if judged else ()
    connections: dict[str, Any] = {}
    with Writer(folder, version=9, storage_plugin=storage) as bag:
        for now, topic, value in sorted(messages, key=lambda one: one[0]):
            made = message(store, topic, value, now)
            kind = made.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], now, store.serialize_cdr(made, kind))


def main() -> None:
    """Make the bag that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path, help='the new bag')
    parser.add_argument('--attempts', type=int, default=30)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--verdicts', action='store_true', help='with a verdict on each attempt')
    given = parser.parse_args()
    write(given.folder, given.attempts, given.seed, judged=given.verdicts)


if __name__ == '__main__':
    main()
