"""Is this the robot that a policy was trained on? What differs is refused before it is moved."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from codetr_ros.robots.mapping import Mapping as Rules
from codetr_ros.robots.robot_facts import RobotFacts

MAY_DIFFER = (
    *('source', 'score', 'episode', 'sampling.by', 'sampling.rate'),
    *('live.watchdog', 'live.stop', 'live.reset', 'live.episode_steps'),
)
"""What watches over a robot, and how its episodes end, may be other than in training: the policy
sees nothing of it.
"""


class AnotherRobotError(ValueError):
    """A robot that differs from the one that a policy was trained on: the message names the field,
    both values, the source and the remedy.
    """


def flat(value: Any, name: str = '') -> Iterator[tuple[str, Any]]:
    """The values of mappings and lists within each other, by names such as observation[0].topic.
    A list of numbers or texts is one value.
    """
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from flat(each, f'{name}.{key}' if name else str(key))
    elif isinstance(value, Sequence) and any(isinstance(each, Mapping) for each in value):
        for i, each in enumerate(value):
            yield from flat(each, f'{name}[{i}]')
    else:
        yield name, value


def differences(trained: Rules, given: Rules, episodes: bool) -> list[tuple[str, Any, Any]]:
    """What decides how a policy acts and is not the same in two mappings.

    Args:
        trained: the mapping under which the policy was trained.
        given: another one.
        episodes: whether the policy sees how far its episode is.

    Returns:
        Name, trained value and given value; None where there is none.
    """
    free = tuple(name for name in MAY_DIFFER if not (episodes and name.endswith('steps')))
    before, now = (dict(flat(rules.model_dump(mode='json'))) for rules in (trained, given))
    names = dict.fromkeys([*before, *now])
    return [
        (name, before.get(name), now.get(name))
        for name in names
        if before.get(name) != now.get(name)
        and not any(name == each or name.startswith(f'{each}.') for each in free)
    ]


def check_mapping(trained: Rules, given: Rules, source: str, policy: str, episodes: bool) -> None:
    """Refuse a mapping under which a policy was not trained.

    Args:
        trained: the mapping that the policy has.
        given: the one of the robot.
        source: name of the second, for the error.
        policy: name of the policy, for the error.
        episodes: whether the policy sees how far its episode is.

    Raises:
        AnotherRobotError: something differs that decides how it acts.
    """
    found = differences(trained, given, episodes)
    if found:
        lines = '; '.join(f'{name} = {now!r}, not {before!r}' for name, before, now in found)
        raise AnotherRobotError(
            f'mapping {source} is that of another robot than the one that {policy} was trained '
            f'on: {lines}. Leave the mapping out (the policy has its own), correct it, or train '
            'a policy for this robot'
        )


def check_types(facts: RobotFacts, there: Mapping[str, Sequence[str]], policy: str) -> None:
    """Refuse topics of other types than in training.

    Args:
        facts: of the robot in training.
        there: the types of the topics that acting takes, by name.
        policy: name of the policy, for the error.

    Raises:
        AnotherRobotError: a topic has another type.
    """
    for topic, expected in facts.types.items():
        types = there.get(topic, ())
        if types and expected not in types:
            raise AnotherRobotError(
                f'{topic} is of type {", ".join(types)} here, and was {expected} when {policy} '
                'was trained: start the driver of that robot, or train a policy for this one'
            )


def check_sizes(facts: RobotFacts, sizes: Sequence[int], size: int, policy: str) -> None:
    """Refuse observations of other sizes than in training.

    Args:
        facts: of the robot in training.
        sizes: the numbers of each entry of the observation, as received.
        size: O of the policy.
        policy: its name, for the error.

    Raises:
        AnotherRobotError: an entry, or the whole, has another size.
    """
    entries = facts.mapping.observation
    for i, (now, before) in enumerate(zip(sizes, facts.sizes, strict=False)):
        if now != before:
            fields = ', '.join(entries[i].fields)
            raise AnotherRobotError(
                f'observation[{i}], {fields} of {entries[i].topic}, has {now} numbers here, and '
                f'had {before} when {policy} was trained: start the driver of that robot, or '
                'train a policy for this one'
            )
    if sum(sizes) != size:
        raise AnotherRobotError(
            f'{policy} acts on observations of {size} numbers, and the topics give '
            f'{sum(sizes)} ({", ".join(map(str, sizes))}): start the driver of the robot that it '
            'was trained on, or train a policy for this one'
        )
