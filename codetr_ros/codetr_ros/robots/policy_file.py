"""The file of a trained policy: all that acting on a robot takes, without the run that made it.

A safetensors file, read by numpy alone. Its metadata have a JSON description with a sha256 of its
own; its tensors are the weights (`policy/`) and examples of what the policy does (`test/`), by
which every start tests itself. There is no pickle in it.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import Field, ValidationError

from codetr_ros.config import SettingsError, explain
from codetr_ros.policy.network import Network, NetworkError, read_network
from codetr_ros.policy.plain import PlainPolicy
from codetr_ros.records import F32
from codetr_ros.robots.robot_facts import RobotFacts
from codetr_ros.runs import checkpoint_names
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.facts import Facts
from codetr_ros.system import tensors
from codetr_ros.system.files import atomic_write
from codetr_ros.system.parsing import ParseError, parse_json, shortened

FORMAT = 1
"""Increased whenever the layout of a policy file changes its meaning."""
WEIGHTS, TEST = 'policy/', 'test/'
EXAMPLES = ('observations', 'steps', 'actions')
ACTION = 'tanh(mean), without noise'
AGAIN = 'export it again with `codetr export RUN`, or restore it from a copy'


class PolicyFileError(ValueError):
    """A policy file that cannot be used: the message names the file, the reason and the remedy."""


class Description(Facts):
    """What a policy file says about its policy."""

    format: int = Field(description='version of the format')
    codetr_ros: str | None = Field(description='version of the program that wrote it')
    run_id: str = Field(description='the run that it is from')
    task: str = Field(description='the task of that run')
    settings_hash: str = Field(description='sha256 of the settings of that run')
    phase: int = Field(description='the phase after which it is the policy', ge=0)
    steps: int = Field(description='steps that had been learnt from', ge=0)
    network: str = Field(description='what `policy.network.Network` describes')
    action: str = Field(description='how an action follows from the network')
    robot: RobotFacts = Field(description='the robot that it was trained on')
    mapping_sha256: str = Field(description='sha256 of the mapping, as canonical JSON')
    tolerance: float = Field(description='by which a tested action may differ', gt=0)
    policy_sha256: str = Field(description='digest of the weights, as in the report of the run')
    tensors_sha256: str = Field(description='digest of all tensors of the file')


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """A policy file that was read.

    Attributes:
        name: for errors.
        described: what it says about its policy.
        network: what the policy is.
        policy: acts.
        examples: observations (N, O), steps (N,) and actions (N, A) by `EXAMPLES`.
    """

    name: str
    described: Description
    network: Network
    policy: PlainPolicy
    examples: Mapping[str, np.ndarray[Any, Any]]

    def test(self) -> float:
        """Compare what the policy does here with what it did when the file was made.

        Returns:
            The largest difference of an action.

        Raises:
            PolicyFileError: one differs by more than the file allows.
        """
        seen, steps, actions = (self.examples[name] for name in EXAMPLES)
        acted = np.array([self.policy.act(o, int(n)) for o, n in zip(seen, steps, strict=True)])
        apart = np.abs(acted - actions).max(axis=1)
        # written so that a difference that is no number fails too
        failed = np.flatnonzero(~(apart <= self.described.tolerance))
        if len(failed):
            i = int(failed[0])
            raise PolicyFileError(
                f'{self.name} fails its own test: for {len(failed)} of {len(seen)} observations '
                f'the action differs by more than {self.described.tolerance:g} from what it was '
                f'when the file was made (example {i}: {acted[i].tolist()}, was '
                f'{actions[i].tolist()}). Compare the versions of numpy, and {AGAIN}'
            )
        return float(apart.max())


def canonical(content: Any) -> str:
    """The JSON of content: the same content gives the same text."""
    return json.dumps(content, sort_keys=True, allow_nan=False, separators=(',', ':'))


def sha256(text: str) -> str:
    """The sha256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def digest(arrays: Mapping[str, np.ndarray[Any, Any]]) -> str:
    """The digest of tensors; of weights the one that checkpoints and reports have."""
    return tensors.digest(
        tensors.Part(name, f'torch.{array.dtype}', array.shape, array.tobytes())
        for name, array in arrays.items()
    )


def write(
    path: Path,
    described: Mapping[str, Any],
    weights: Mapping[str, F32],
    examples: Mapping[str, np.ndarray[Any, Any]],
) -> None:
    """Write a policy file whole or not at all.

    Args:
        path: the file; an existing one is replaced.
        described: the fields of `Description` but for the two digests, which are added.
        weights: of the policy.
        examples: as in `PolicyFile`.

    Raises:
        OSError: the file cannot be written.
    """
    held = {f'{WEIGHTS}{name}': array for name, array in weights.items()}
    held |= {f'{TEST}{name}': array for name, array in examples.items()}
    digests = {'policy_sha256': digest(weights), 'tensors_sha256': digest(held)}
    text = canonical(dict(described) | digests)
    metadata = {'description': text, 'sha256': sha256(text)}
    atomic_write(path, safetensors.numpy.save(held, metadata))


def find(path: Path) -> Path:
    """The policy file that a path names: the file itself, or the one of a run, where the path is
    the run's folder or one of the learner's checkpoints in it.

    Raises:
        PolicyFileError: there is none, or the checkpoints have one that is newer or other.
    """
    if not path.is_dir():
        return path
    run, named = path, None
    if path.parent.name == run_folder.CHECKPOINTS:
        run, named = path.parent.parent, path
    elif path.name == run_folder.CHECKPOINTS:
        run = path.parent
    file = run / run_folder.POLICY
    if not file.is_file():
        raise PolicyFileError(
            f'{path} has no policy file, {file}: make it with `codetr export {run}`, or name the '
            'file that --out gave it'
        )
    newest = named or checkpoint_names.latest(run / run_folder.CHECKPOINTS, 'learner')
    made_after = load(file).described.phase
    if newest is not None and checkpoint_names.phase_of(newest) != made_after:
        raise PolicyFileError(
            f'{file} has the policy after phase {made_after}, not that of {newest}: make it anew '
            f'with `codetr export {run}`, or name the file itself'
        )
    return file


def load(path: Path) -> PolicyFile:
    """Read a policy file and check its digests; `PolicyFile.test` checks what it does.

    Raises:
        PolicyFileError: it cannot be read, is damaged, or of another version.
    """
    name = f'policy file {path}'
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PolicyFileError(f'{name} cannot be read ({error.strerror}): {AGAIN}') from None
    held, metadata = _content(data, name)
    described = _described(metadata, name)
    if (actual := digest(held)) != described.tensors_sha256:
        raise PolicyFileError(
            f'{name} is damaged: the digest of its tensors is {actual}, should be '
            f'{described.tensors_sha256}: {AGAIN}'
        )
    weights, examples = (
        {key.removeprefix(of): array for key, array in held.items() if key.startswith(of)}
        for of in (WEIGHTS, TEST)
    )
    try:
        network = read_network(described.network, name)
        policy = PlainPolicy(network, weights, name)
    except NetworkError as error:
        raise PolicyFileError(f'{error}: {AGAIN}') from None
    _check_examples(examples, network, name)
    return PolicyFile(name, described, network, policy, examples)


def _content(data: bytes, name: str) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, str]]:
    """The tensors of a file, and its metadata."""
    try:
        held = {key: array.copy() for key, array in safetensors.numpy.load(data).items()}
        size = int.from_bytes(data[:8], 'little')  # of the header, which the line above has read
        metadata = parse_json(data[8 : 8 + size]).get('__metadata__', {})
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise PolicyFileError(
            f'{name} is no policy file, or is damaged: its {len(data)} bytes are not safetensors '
            f'({error}): {AGAIN}'
        ) from None
    return held, metadata


def _described(metadata: Mapping[str, str], name: str) -> Description:
    """The description in the metadata of a file."""
    text = metadata.get('description', '')
    if not text:
        raise PolicyFileError(
            f'{name} is a safetensors file without the description of a policy: name a file that '
            '`codetr export` has made, not one of a checkpoint'
        )
    if (actual := sha256(text)) != metadata.get('sha256'):
        raise PolicyFileError(
            f'{name} is damaged: sha256 of its description is {actual}, should be '
            f'{metadata.get("sha256")}: {AGAIN}'
        )
    try:
        content = parse_json(text)
        version = content.get('format') if isinstance(content, dict) else None
        if version != FORMAT:
            raise PolicyFileError(
                f'{name} has format = {shortened(repr(version))}, but this version of codetr_ros '
                f'reads {FORMAT}: act with the version that wrote it, or {AGAIN}'
            )
        return Description.model_validate(content)
    except ValidationError as error:
        raise PolicyFileError(f'{explain(error, name)}: {AGAIN}') from None
    except (ParseError, SettingsError) as error:
        raise PolicyFileError(f'{name}: its description {error}: {AGAIN}') from None


def _check_examples(
    examples: Mapping[str, np.ndarray[Any, Any]], network: Network, name: str
) -> None:
    """Refuse a file without examples that fit its network."""
    count = len(examples.get('steps', ()))
    expected = {
        'observations': (count, network.observation_size),
        'steps': (count,),
        'actions': (count, network.action_size),
    }
    if {key: array.shape for key, array in examples.items()} != expected or not count:
        raise PolicyFileError(
            f'{name} has no examples to test itself by that fit its network: {AGAIN}'
        )
