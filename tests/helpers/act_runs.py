"""The node `act` in a real process, beside the stand-in arm: no run, no learner."""

from pathlib import Path
from typing import Any

from codetr_ros.policy.network import PLAIN, Network
from codetr_ros.robots import mapping
from codetr_ros.robots.policy_export import export
from codetr_ros.robots.robot_facts import RobotFacts
from codetr_ros.runs import folder as run_folder
from helpers import nodes, policies, robot_runs
from helpers.robot_runs import RobotRun, robot_settings


class ActRun(RobotRun):
    """An arm, and nodes that act on it by a policy file. A context manager: on leaving it, none is
    left.

    Args:
        folder: takes logs and policy files.
        live: entries of the mapping's part `live`.
    """

    def __init__(self, folder: Path, **live: Any) -> None:
        super().__init__(robot_settings(), folder, **live)
        self.rules = mapping.load(robot_runs.mapping(folder, **live))

    def begin(self, *others: str, inspection: bool = False) -> None:
        """Start the arm, in which nothing goes wrong."""
        self.start_other('arm', 'stand_in.py', '--sound', *others)

    def policy(self, rules: mapping.Mapping | None = None, **types: str) -> Path:
        """A policy file.

        Args:
            rules: the mapping under which it was trained; None: that of the arm.
            types: those of topics, without their slash.
        """
        robot = RobotFacts(
            mapping=rules or self.rules,
            types={'/joint_states': policies.JOINT_STATE}
            | {f'/{topic}': kind for topic, kind in types.items()},
            sizes=(4,),
        )
        number = len(list(self.folder.glob('*.safetensors')))
        path = self.folder / f'{number}.safetensors'
        export(policies.policy(Network(PLAIN, 4, 2, (16,))), robot, self.settings, path)
        return path

    def act(self, name: str, policy: Path, *parameters: str) -> None:
        """Start a node that acts by a policy file, with parameters such as `autostart:=true`."""
        given = (f'checkpoint:={policy}', *parameters)
        more = [word for parameter in given for word in ('-p', parameter)]
        named = ('-r', f'__ns:={nodes.NAMESPACE}', '-r', f'__node:={name}')
        self.start_python(name, '-m', 'learner_node.act', '--ros-args', *named, *more)

    def log(self, name: str) -> str:
        """What a node has logged."""
        path = self.folder / run_folder.LOGS / f'{name}.log'
        return path.read_text() if path.exists() else ''

    def mapped(self, name: str) -> str:
        """The files that a process has mapped into its memory, its libraries among them."""
        (node,) = [node for node in self._processes.nodes if node.name == name]
        return Path(f'/proc/{node.process.pid}/maps').read_text()
