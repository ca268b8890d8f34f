"""The one configuration of a run: typed, validated, and the origin of CLI flags, YAML keys and ROS
parameters.

The defaults are the paper's (its supplement's Table 1 and A.2; where that is silent, the decision
is marked "decided here"). Presets change some of them: `quick`, `cpu` and `paper` are the YAML
files of `presets/`.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from codetr_ros.records import PROTOCOL_VERSION, RunSpec

Composite = Literal[
    'sum', 'sum_square', 'square_sum', 'max', 'max_hard', 'max_log_sum_exp', 'max_times_n'
]
Method = Literal[
    'codetr', 'none', 'rbt', 'rrd', 'ircr', 'hc', 'lirpg', 'mlp', 'uniform', 'true', 'ones'
]
Hidden = tuple[Annotated[int, Field(ge=1, le=65536)], ...]
IN_PROCESS_ONLY = {
    'true': 'is a reference that looks at what no node may see',
    'ones': 'is a reference that ignores the scores',
    'lirpg': 'learns on-policy, each phase from its own steps alone',
}
"""Methods that run without nodes only, and what keeps them from it."""
SCORE_LEARNERS: tuple[str, ...] = ('hc', 'lirpg')
"""Methods whose policy learner learns from the composite rewards themselves: no reward node labels
steps for it."""
PRESETS = ('quick', 'cpu', 'paper')


class SettingsError(ValueError):
    """A setting that is unknown or out of range: the message names it, its value and what is
    allowed.
    """


class Group(BaseModel):
    """Base of all settings: immutable, nothing unknown, nothing converted that would hide a
    mistake.
    """

    model_config = ConfigDict(
        extra='forbid', frozen=True, validate_default=True, allow_inf_nan=False
    )


class CodetrSettings(Group):
    """The reward transformer (the supplement's Table 1)."""

    layers: int = Field(3, ge=1, le=24, description='causal transformer layers')
    heads: int = Field(4, ge=1, le=64, description='attention heads of each causal layer')
    embedding: int = Field(
        256, ge=4, le=4096, description='embedding dimension d; divisible by heads'
    )
    dropout: float = Field(
        0.1, ge=0, lt=1, description='dropout of embeddings, attention and residuals'
    )
    batch: int = Field(64, ge=1, le=65536, description='segments in a gradient step')
    learning_rate: float = Field(5e-5, gt=0, le=1, description='AdamW learning rate')
    weight_decay: float = Field(1e-4, ge=0, le=1, description='AdamW weight decay')
    warmup_gradient_steps: int = Field(
        100, ge=0, le=10**7, description='gradient steps of linear learning-rate warm-up'
    )
    schedule: Literal['constant', 'cosine'] = Field(
        'cosine',
        description='learning rate after its warm-up (decided here; not in the supplement)',
    )
    total_gradient_steps: int = Field(
        10_000,
        ge=1,
        le=10**9,
        description='gradient steps after which the cosine schedule has decayed to a tenth',
    )
    first_gradient_steps: int = Field(
        100, ge=0, le=10**6, description='gradient steps after the last warm-up phase'
    )
    gradient_steps: int = Field(
        10, ge=0, le=10**6, description='gradient steps after every later phase'
    )
    tokens: Literal['pair', 'merged'] = Field(
        'pair',
        description='pair: a state and an action token per step, as the paper; merged: one, '
        'twice as fast',
    )
    head_scale: Literal['inverse', 'inverse_sqrt', 'one'] = Field(
        'inverse_sqrt',
        description='factor on the in-sequence logits: 1/d, 1/sqrt(d) (decided here) '
        'or 1 (published code)',
    )
    initialisation: Literal['gpt2', 'lecun'] = Field(
        'gpt2',
        description='initial weights: small, nearly one step at a time, as GPT-2 (decided here), '
        'or of variance 1/inputs',
    )
    weights: Literal['attention', 'one'] = Field(
        'attention',
        description='w_t: column sums of the in-sequence attention, or fixed to 1 (an ablation)',
    )
    attention_scope: Literal['segment', 'window'] = Field(
        'segment',
        description='in-sequence attention sees the segment only, or the context before it as '
        'well',
    )
    context: Literal['segment', 'episode'] = Field(
        'segment',
        description='the causal transformer starts at the segment, or up to `window` steps '
        'before it',
    )
    label: Literal['product', 'rhat'] = Field(
        'product',
        description='the step reward: w_t * rhat_t, whose sum is the prediction, or rhat_t',
    )
    labelling: Literal['segment', 'window'] = Field(
        'segment',
        description='label whole segments in one pass, or each step from the `window` steps '
        'that end with it',
    )
    window: int = Field(100, ge=1, le=10_000, description='prediction window H [steps]')
    normalise_observations: bool = Field(
        True, description='standardise observations by warm-up mean and deviation (decided here)'
    )
    label_batch: int = Field(
        256,
        ge=1,
        le=65536,
        description='segments or windows labelled between two looks at arriving messages; a GPU '
        'wants thousands',
    )
    precision: Literal['float32', 'bfloat16'] = Field(
        'float32',
        description="of the causal layers' products; weights and heads are float32 in any case. "
        'bfloat16 rounds to 8 bits, and is faster for large networks where the processor has it '
        '(avx512_bf16, amx)',
    )

    @model_validator(mode='after')
    def _heads_divide_embedding(self) -> 'CodetrSettings':
        if self.embedding % self.heads:
            raise ValueError(f'embedding={self.embedding} is not divisible by heads={self.heads}')
        return self


class RbtSettings(Group):
    """What RBT has beyond the transformer, whose settings it shares with CoDeTr (`codetr`).

    Of those, `weights`, `label`, `context` and `attention_scope` are CoDeTr's alone.
    """

    state_loss_weight: float = Field(
        1.0, ge=0, le=1000, description='weight of the loss on the predicted next observation'
    )
    attention_scope: Literal['segment', 'window'] = Field(
        'window',
        description='attention sees the segments that fit into `codetr.window` steps (two at '
        'least), as published, or one only',
    )


class PerceptronSettings(Group):
    """A reward model that sees one step at a time."""

    hidden: Hidden = Field(
        (256, 256), min_length=1, max_length=8, description='hidden layer widths of the reward net'
    )
    learning_rate: float = Field(3e-4, gt=0, le=1, description='AdamW learning rate')
    weight_decay: float = Field(
        0.0, ge=0, le=1, description='AdamW weight decay; 0 makes it plain Adam'
    )
    first_gradient_steps: int = Field(
        100, ge=0, le=10**6, description='gradient steps after the last warm-up phase'
    )
    gradient_steps: int = Field(
        10, ge=0, le=10**6, description='gradient steps after every later phase'
    )
    normalise_observations: bool = Field(
        True, description='standardise observations by warm-up mean and deviation (decided here)'
    )


class MlpSettings(PerceptronSettings):
    """The Markovian control: trained on segments as the transformer is."""

    batch: int = Field(64, ge=1, le=65536, description='segments in a gradient step')


class RrdSettings(PerceptronSettings):
    """Randomized return decomposition (Ren et al., arXiv 2111.13485)."""

    loss: Literal['biased', 'unbiased'] = Field(
        'biased',
        description='the published default, or less the variance that the drawing of steps adds',
    )
    subsequences: int = Field(
        4, ge=1, le=65536, description='segments in a gradient step, drawn by their lengths'
    )
    subsequence_steps: int = Field(
        64, ge=2, le=65536, description='steps K drawn from each segment'
    )
    first_gradient_steps: int = Field(
        1000, ge=0, le=10**6, description='gradient steps after the last warm-up phase'
    )
    gradient_steps: int = Field(
        1000,
        ge=0,
        le=10**6,
        description='gradient steps after every later phase; published: one for each SAC update',
    )


class SacSettings(Group):
    """Soft actor-critic as jaxrl has it."""

    hidden: Hidden = Field(
        (256, 256), min_length=1, max_length=8, description='hidden layer widths'
    )
    batch: int = Field(256, ge=1, le=65536, description='steps in an update')
    actor_learning_rate: float = Field(
        3e-4, gt=0, le=1, description='Adam learning rate of the actor'
    )
    critic_learning_rate: float = Field(
        3e-4, gt=0, le=1, description='Adam learning rate of the critics'
    )
    temperature_learning_rate: float = Field(
        3e-4, gt=0, le=1, description='Adam learning rate of the temperature'
    )
    discount: float = Field(0.99, ge=0, le=1, description='discount factor gamma')
    tau: float = Field(0.005, gt=0, le=1, description='Polyak step of the target critics')
    initial_temperature: float = Field(
        1.0, gt=0, le=1000, description='entropy temperature at the start'
    )
    target_entropy: float = Field(
        -0.5,
        ge=-10,
        le=10,
        description='target entropy in units of the action size: -0.5 as jaxrl, often -1 '
        'elsewhere',
    )
    updates_per_step: float = Field(1.0, ge=0, le=100, description='updates per environment step')
    burst: int = Field(
        50, ge=1, le=100_000, description='updates between two looks at arriving messages'
    )
    compile: bool = Field(
        True,
        description='compile the update for this processor, or the GPU of `device`: faster, but '
        'needs a C++ compiler, and the first start takes about half a minute more, later ones '
        'some seconds (what was compiled is kept in ~/.cache/codetr_ros/torch)',
    )


class HcSettings(Group):
    """The critic of method `hc` (Han et al., arXiv 2106.11854); the rest of it is `sac`'s."""

    history: Literal['singleton', 'recurrent'] = Field(
        'recurrent',
        description='value of the history: a sum over its steps, or of a GRU that reads it',
    )
    regulariser: float = Field(
        5.0,
        ge=0,
        le=1e6,
        description="weight of (H(whole segment) - score)^2 in the critics' loss; 0: none",
    )
    width: int = Field(128, ge=1, le=65536, description='width of the GRU')
    segments: int = Field(
        16,
        ge=1,
        le=65536,
        description='segments from which the sac.batch steps of an update are drawn '
        '(decided here)',
    )


class LirpgSettings(Group):
    """PPO with a learnt intrinsic reward (Zheng et al., arXiv 1804.06459); its constants."""

    hidden: Hidden = Field(
        (64, 64), min_length=1, max_length=8, description='hidden layer widths of all networks'
    )
    learning_rate: float = Field(
        3e-4, gt=0, le=1, description='Adam learning rate of the policy and its value'
    )
    reward_learning_rate: float = Field(
        1e-4,
        gt=0,
        le=1,
        description='Adam learning rate of the intrinsic reward and the value of scores',
    )
    epsilon: float = Field(1e-5, gt=0, le=1, description="Adam's epsilon")
    epochs: int = Field(10, ge=1, le=1000, description='passes over the steps of a phase')
    batch: int = Field(64, ge=2, le=65536, description='steps in an update')
    clip: float = Field(0.2, gt=0, le=1, description="clip range of PPO's probability ratio")
    discount: float = Field(0.99, ge=0, le=1, description='discount factor gamma')
    trace_decay: float = Field(
        0.95, ge=0, le=1, description='lambda of the generalised advantage estimation'
    )
    intrinsic_coefficient: float = Field(
        1.0, ge=0, le=1e6, description='weight of the intrinsic reward in what the policy learns'
    )
    extrinsic_coefficient: float = Field(
        0.0, ge=0, le=1e6, description='weight of the scores in what the policy learns'
    )
    value_coefficient: float = Field(0.5, ge=0, le=1e6, description='weight of the value losses')
    gradient_norm: float = Field(
        0.5, gt=0, le=1e6, description='gradients are shortened to this norm'
    )


class Settings(Group):
    """Everything that the nodes of a run must agree on."""

    task: str = Field(
        'Ant-v4', min_length=1, description='task: a name of `codetr tasks` or any Gymnasium id'
    )
    composite: Composite = Field(
        'sum', description="how a segment's rewards make its composite reward"
    )
    beta: float = Field(3.0, gt=0, le=1000, description='inverse temperature of the soft maximum')
    delay: int = Field(
        25,
        ge=1,
        le=100_000,
        description='steps n of a segment: one composite reward comes for each',
    )
    method: Method = Field(
        'codetr', description='how step rewards are made from composite rewards'
    )
    steps: int = Field(1_000_000, ge=1, le=10**9, description='environment steps of the run')
    seed: int = Field(0, ge=0, le=2**31 - 1, description='seed of everything random')
    phase_steps: int = Field(1000, ge=1, le=10**6, description='environment steps of a phase')
    warmup_steps: int = Field(
        10_000,
        ge=1,
        le=10**8,
        description='uniformly random steps at the start, rounded up to whole phases',
    )
    overlap: bool = Field(
        False,
        description='simulate phase k under what phase k-2 taught, while phase k-1 is learnt from',
    )
    simulators: int = Field(
        1, ge=1, le=64, description='simulators among whom the steps of a phase are divided'
    )
    envs: int = Field(
        1,
        ge=1,
        le=64,
        description='environments of each simulator, among which its steps are divided; they are '
        'stepped in threads, as many as there are processors, where that is faster',
    )
    memory_steps: int = Field(
        1_000_000, ge=1, le=10**9, description='steps that the memory D holds'
    )
    evaluate_every: int = Field(
        5000, ge=0, le=10**9, description='steps between evaluations; 0: none'
    )
    evaluate_episodes: int = Field(10, ge=1, le=10_000, description='episodes of an evaluation')
    r_max: float | None = Field(
        None,
        gt=0,
        le=1e9,
        description="largest reward of a step, for scores; the task's own where not given",
    )
    target_scale: Literal['rms', 'none'] = Field(
        'rms',
        description='unit c of composite rewards: root mean square per step of the warm-up '
        '(decided here), or 1',
    )
    reward_unit: Literal['scaled', 'raw'] = Field(
        'scaled',
        description='step rewards that the learner sees: in units of c (decided here), or '
        'unscaled',
    )
    relabel_steps: int = Field(
        0,
        ge=0,
        le=10**9,
        description='steps of the memory that are labelled again in a phase, whole segments with '
        'the oldest labels first, one at least; what is new is always labelled; 0: all',
    )
    relabel: Literal['all', 'drawn'] = Field(
        'all',
        description='steps of the memory that are labelled again in a phase: all, or those that '
        'the updates after it will draw, which is known beforehand: SAC sees the newest labels '
        'either way. Worth its while with `codetr.labelling` window in a large memory; else whole '
        'segments are labelled that hold such a step',
    )
    record_relabels: Literal['first', 'all'] = Field(
        'first',
        description='labels in the bag: the first of each segment and, at evaluations, all that '
        'the phase gave, or every one',
    )
    threads: int = Field(1, ge=1, le=256, description='torch threads of each process')
    device: str = Field(
        'cpu',
        pattern=r'^(cpu|cuda(:\d{1,2})?)$',
        description='where SAC learns: cpu, or the GPU cuda, cuda:1, ... of the learner',
    )
    reward_device: str = Field(
        'cpu',
        pattern=r'^(cpu|cuda(:\d{1,2})?)$',
        description='where a reward model with a network learns and labels: cpu, or the GPU cuda, '
        'cuda:1, ... of the reward node; all else runs on the CPU',
    )
    codetr: CodetrSettings = Field(
        default_factory=CodetrSettings, description='the reward transformer'
    )
    rbt: RbtSettings = Field(
        default_factory=RbtSettings, description='RBT, beyond the reward transformer'
    )
    rrd: RrdSettings = Field(
        default_factory=RrdSettings, description='randomized return decomposition'
    )
    mlp: MlpSettings = Field(
        default_factory=MlpSettings, description='the reward model of single steps'
    )
    sac: SacSettings = Field(default_factory=SacSettings, description='the policy learner')
    hc: HcSettings = Field(default_factory=HcSettings, description='the critic of method hc')
    lirpg: LirpgSettings = Field(
        default_factory=LirpgSettings, description='the policy learner of method lirpg'
    )

    @model_validator(mode='after')
    def _on_policy_in_lock_step(self) -> 'Settings':
        if self.method == 'lirpg' and self.overlap:
            raise ValueError(
                'overlap=True with method=lirpg: it learns on-policy, from steps under the very '
                'policy that it changes; set overlap=False'
            )
        return self

    @model_validator(mode='after')
    def _a_gpu_has_a_use(self) -> 'Settings':
        if self.device != 'cpu' and not self.labels_steps:
            raise ValueError(
                f'device={self.device} with method={self.method}: its policy learner runs on the '
                'CPU only; set device=cpu'
            )
        return self

    @model_validator(mode='after')
    def _what_is_drawn_is_known(self) -> 'Settings':
        if self.relabel == 'all':
            return self
        if not self.labels_steps:
            raise ValueError(
                f'relabel={self.relabel} with method={self.method}: its policy learner draws no '
                'labelled steps; set relabel=all'
            )
        if self.device != 'cpu':
            raise ValueError(
                f'relabel={self.relabel} with device={self.device}: SAC draws there from a '
                "generator of the device's own, and nobody else knows what; set device=cpu or "
                'relabel=all'
            )
        if self.relabel_steps:
            raise ValueError(
                f'relabel={self.relabel} with relabel_steps={self.relabel_steps}: one labels '
                'again all that will be drawn, the other so many of the oldest; set '
                'relabel_steps=0 or relabel=all'
            )
        return self

    @property
    def labels_steps(self) -> bool:
        """Whether a reward method labels steps, from which the policy is then learnt."""
        return self.method not in SCORE_LEARNERS

    @property
    def roles(self) -> dict[str, int]:
        """How many nodes of each role the run needs."""
        needed = {
            'sim': self.simulators,
            'evaluate': int(self.evaluate_every > 0),
            'reward': int(self.labels_steps),
            'record': 1,
            'learner': 1,
        }
        return {role: count for role, count in needed.items() if count}

    @property
    def phases(self) -> int:
        """Phases of the run; the last may be shorter."""
        return -(-self.steps // self.phase_steps)

    @property
    def warmup_phases(self) -> int:
        """Phases under the random policy: a phase begun is ended so."""
        return min(self.phases, -(-self.warmup_steps // self.phase_steps))

    @property
    def lag(self) -> int:
        """Phases from what taught a policy to where it acts: 1 in lock-step, 2 with overlap."""
        return 2 if self.overlap else 1

    def steps_of(self, phase: int) -> int:
        """Environment steps of a phase, all sources together; 0 beyond the last."""
        return max(0, min(self.phase_steps, self.steps - phase * self.phase_steps))

    def shares_of(self, phase: int) -> list[int]:
        """Steps that each source takes of a phase: the first ones take one more where it does not
        divide.
        """
        share, rest = divmod(self.steps_of(phase), self.source_count)
        return [share + (i < rest) for i in range(self.source_count)]

    def steps_after(self, version: int) -> int:
        """Environment steps that policy version `version` has learnt from."""
        return min(self.steps, (version + 1) * self.phase_steps)

    @property
    def relabels_all(self) -> bool:
        """Whether each version of the reward model labels all of the memory."""
        return self.relabel == 'all' and not self.relabel_steps

    def evaluated(self, version: int) -> bool:
        """Whether this policy version is evaluated: the last one, and the first past each
        multiple.

        Policies of the warm-up act at random and are not evaluated again: the random policy is,
        once, at step 0.
        """
        if self.evaluate_every == 0 or version < self.warmup_phases - 1:
            return False
        if version == self.phases - 1:
            return True
        return (
            self.steps_after(version) // self.evaluate_every
            > self.steps_after(version - 1) // self.evaluate_every
        )

    def canonical(self) -> str:
        """The settings as JSON, the same for the same settings on every machine."""
        return json.dumps(self.model_dump(mode='json'), sort_keys=True, separators=(',', ':'))

    def hash(self) -> str:
        """sha256 of `canonical`."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()

    def run_spec(self, run_id: str) -> RunSpec:
        """The record that says what run this is."""
        return RunSpec(run_id, PROTOCOL_VERSION, self.seed, self.canonical(), self.hash())

    @property
    def simulator_names(self) -> tuple[str, ...]:
        """Names that `codetr train` gives the run's simulators: sim, sim_2, sim_3, ..."""
        return ('sim', *(f'sim_{i}' for i in range(2, self.simulators + 1)))

    @property
    def source_count(self) -> int:
        """Sources of the run: environments of all simulators."""
        return self.simulators * self.envs

    def sources_of(self, simulator: str) -> tuple[str, ...]:
        """Names of a simulator's sources: its own where it has one environment; sim-1, sim-2, ...
        where it has several.
        """
        if self.envs == 1:
            return (simulator,)
        return tuple(f'{simulator}-{i}' for i in range(1, self.envs + 1))

    def simulator_of(self, source: str) -> str:
        """The simulator whose source it is. No node's name has a hyphen."""
        return source if self.envs == 1 else source.rpartition('-')[0]

    def flat(self) -> dict[str, Any]:
        """Every setting by its dotted name, as ROS parameters and errors call it."""
        return dict(flatten(self.model_dump()))

    def changed(self, changes: Mapping[str, Any], source: str = 'change') -> 'Settings':
        """A copy with some settings changed, given by dotted name.

        Raises:
            SettingsError: a name is unknown or a value is not allowed; `source` says where it came
                from.
        """
        data = self.model_dump()
        for name, value in changes.items():
            *groups, last = name.split('.')
            place = data
            for group in groups:
                place = place.get(group, {}) if isinstance(place, dict) else {}
            if not isinstance(place, dict) or last not in place:
                raise SettingsError(
                    f'{source}: there is no setting {name!r} (value {value!r}). Settings are: '
                    f'{", ".join(self.flat())}'
                )
            place[last] = value
        return parse(data, source)


def flatten(data: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Values of nested mappings, each with its dotted name."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


def parse(data: Mapping[str, Any], source: str) -> Settings:
    """Validate settings that came from outside.

    Args:
        data: nested mapping of settings; what is missing keeps its default.
        source: where they came from (a file, a node, the command line), for the error.

    Raises:
        SettingsError: names every offending setting, its value and what is allowed.
    """
    return validate(Settings, data, source)


_G = TypeVar('_G', bound=Group)


def validate(kind: type[_G], data: Any, source: str) -> _G:
    """Validate a group of settings that came from outside.

    Args:
        kind: the group.
        data: nested mapping of settings; what is missing keeps its default.
        source: where they came from (a file, a node, the command line), for the error.

    Raises:
        SettingsError: names every offending setting, its value and what is allowed.
    """
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise SettingsError(explain(error, source)) from None


def explain(error: ValidationError, source: str) -> str:
    """What pydantic refuses, a line for each value: where it came from, name, value and reason."""
    lines = []
    for e in error.errors():
        name = '.'.join(str(part) for part in e['loc']) or 'settings'
        value = '' if isinstance(e['input'], Mapping) else f' = {e["input"]!r}'
        said = 'there is no such setting' if e['type'] == 'extra_forbidden' else e['msg']
        lines.append(f'{source}: {name}{value}: {said}')
    return '\n'.join(lines)


def load(name: str) -> Settings:
    """Settings of a preset (`quick`, `cpu`, `paper`) or of a YAML file.

    Raises:
        SettingsError: no such preset or file, not YAML, or a setting that is refused.
    """
    if name in PRESETS:
        text = resources.files('codetr_ros.presets').joinpath(f'{name}.yaml').read_text()
        source = f'preset {name}'
    else:
        path = Path(name)
        if not path.is_file():
            raise SettingsError(
                f'config {name!r} is neither a preset ({", ".join(PRESETS)}) nor a file'
            )
        text, source = path.read_text(), str(path)
    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingsError(f'{source} is not YAML: {error}') from None
    if not isinstance(data, Mapping):
        raise SettingsError(f'{source} must hold a mapping of settings, not {type(data).__name__}')
    return parse(data, source)


def from_canonical(text: str, source: str) -> Settings:
    """Settings from the JSON of a `RunSpec`.

    Raises:
        SettingsError: not JSON, or a setting that is refused.
    """
    try:
        data = json.loads(text)
    except ValueError as error:
        raise SettingsError(f'{source}: the settings are not JSON: {error}') from None
    return parse(data, source)
