"""The one configuration of a run: typed, validated, and the source of CLI flags, YAML keys and ROS
parameters.

The defaults are the paper's (its supplement's Table 1 and A.2). Decisions that the paper leaves
open are marked "decided here". The presets `quick`, `cpu` and `paper`, the YAML files of
`presets/`, change some defaults.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, model_validator

from codetr_ros.config.base import Group, SettingsError, flatten, in_words, validate
from codetr_ros.config.choices import SCORE_LEARNERS, Composite, Joiners, Method, Scorer, Scorers
from codetr_ros.config.delays import Delay, Delayed
from codetr_ros.config.methods import (
    AggregateSettings,
    CodetrSettings,
    DiasterSettings,
    EvidenceSettings,
    HcSettings,
    LirpgSettings,
    LrrSettings,
    MilLstmSettings,
    MlpSettings,
    RbtSettings,
    RrdSettings,
    SacSettings,
)
from codetr_ros.config.people import PeopleSettings, Scored
from codetr_ros.config.schedule import ROBOT, Schedule
from codetr_ros.config.threads import Threaded, Threads
from codetr_ros.records import PROTOCOL_VERSION, RunSpec

_DEVICE = in_words(
    r'^(cpu|cuda(:\d{1,2})?)$', 'cpu, or a GPU: cuda, or cuda and its number, such as cuda:1'
)


class Settings(Schedule, Delayed, Scored, Threaded, Group):
    """Everything that the nodes of a run must agree on."""

    task: str = Field(
        'Ant-v4',
        min_length=1,
        description='task: a name of `codetr tasks`, any Gymnasium id, or module:id',
    )
    composite: Composite = Field(
        'sum', description="how a segment's rewards make its composite reward"
    )
    beta: float = Field(
        3.0, gt=0, le=1000, description='inverse temperature of the soft maximum and minimum'
    )
    delay: Delay = Field(
        25,
        description='steps n of a segment; each segment has one composite reward. 10:50 draws the '
        'length of each from 10 to 50 steps; episode: a segment is a whole episode',
    )
    score_missing: float = Field(
        0.0,
        ge=0,
        lt=1,
        description='share of segments that get no score, drawn by the seed: their steps are '
        'labelled by what is learnt from the others',
    )
    score_noise: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="noise of scores, in standard deviations of the random policy's scores; "
        'evaluations have the true ones',
    )
    score_levels: int = Field(
        0,
        ge=0,
        le=1000,
        description='levels of an ordinal scale on which segments are scored, 1 (worst) to so '
        "many, as many of the random policy's scores on each; 0: scores are numbers",
    )
    scorer: Scorer = Field(
        'simulator',
        description='who scores segments: the simulator; a person on a page, who may come and go; '
        'whoever publishes on the topic (topic); or simulated people. All but the simulator score '
        'when they like and as much as they like, and the run waits for none of them',
    )
    scorers: Scorers = Field(
        (),
        max_length=64,
        description='names of those beside the simulators whose scores are taken: a person, an '
        'inspection; scores of anybody else are refused. Where another than the simulator scores, '
        'no names stand for anybody',
    )
    requests: int = Field(
        8,
        ge=0,
        le=1000,
        description='segments whose scores are asked for after each phase, those worth most '
        'first, where another than the simulator scores',
    )
    people: PeopleSettings = Field(
        default_factory=PeopleSettings, description='simulated people, with `scorer` simulated'
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
        description='simulate phase k with the policy learnt up to phase k-2, while phase k-1 is '
        'learnt from',
    )
    pace: Literal['permitted', 'free'] = Field(
        'permitted',
        description='permitted: each phase waits for its permission; free: a robot goes on under '
        'its newest policy while the learner learns, at most 8 phases ahead of it',
    )
    simulators: int = Field(
        1, ge=1, le=64, description='simulators that share the steps of a phase'
    )
    joiners: Joiners = Field(
        (),
        max_length=64,
        description='names of further simulators that share the steps of a phase, but need not be '
        'there at the start: they join the running run, leave it and join it again. The share of '
        'those that are not there is missing',
    )
    envs: int = Field(
        1,
        ge=1,
        le=64,
        description='environments of each simulator, which share its steps',
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
        description="largest reward of a step, for scores; if not given, the task's own",
    )
    target_scale: Literal['rms', 'none'] = Field(
        'rms',
        description='unit c of composite rewards: root mean square per step of the warm-up '
        '(decided here), or 1',
    )
    reward_unit: Literal['scaled', 'raw'] = Field(
        'scaled',
        description='step rewards for the learner: in units of c, or of the level of scores for '
        'methods whose labels are no shares of scores (decided here); or unscaled',
    )
    relabel_steps: int = Field(
        0,
        ge=0,
        le=10**9,
        description='steps of the memory to label again in a phase: whole segments, oldest labels '
        'first, at least one; new steps are always labelled; 0: all',
    )
    relabel: Literal['all', 'drawn'] = Field(
        'all',
        description='steps of the memory to label again in a phase: all, or those that the next '
        'updates will draw, which are known beforehand. SAC sees the newest labels either way. '
        'drawn pays with `codetr.labelling` window in a large memory; with segment it labels '
        'every segment that holds such a step',
    )
    record_relabels: Literal['first', 'all'] = Field(
        'first',
        description='labels in the bag: the first of each segment and, at evaluations, all labels '
        'of the phase; or every label',
    )
    threads: Threads = Field(
        'auto',
        description='torch threads of each process, which decide the last bits; auto: when the '
        'run is made, the cores that a stage has to itself where SAC gains from them, at most 4, '
        'else 1',
    )
    device: str = Field(
        'cpu',
        pattern=_DEVICE,
        description='where SAC learns: cpu, or the GPU cuda, cuda:1, ... of the learner',
    )
    reward_device: str = Field(
        'cpu',
        pattern=_DEVICE,
        description='where a reward model with a network learns and labels: cpu, or the GPU cuda, '
        'cuda:1, ... of the reward node; everything else runs on the CPU',
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
    diaster: DiasterSettings = Field(
        default_factory=DiasterSettings, description='differences of sub-trajectory rewards'
    )
    lrr: LrrSettings = Field(
        default_factory=LrrSettings, description='likelihood reward redistribution'
    )
    mil_lstm: MilLstmSettings = Field(
        default_factory=MilLstmSettings, description='the recurrent multiple-instance model'
    )
    mlp: MlpSettings = Field(
        default_factory=MlpSettings, description='the reward model of single steps'
    )
    aggregate: AggregateSettings = Field(
        default_factory=AggregateSettings, description='the learnt aggregator'
    )
    evidence: EvidenceSettings = Field(
        default_factory=EvidenceSettings,
        description='Bayesian regression of scores on features of single steps',
    )
    sac: SacSettings = Field(default_factory=SacSettings, description='the policy learner')
    hc: HcSettings = Field(default_factory=HcSettings, description='the critic of method hc')
    lirpg: LirpgSettings = Field(
        default_factory=LirpgSettings, description='the policy learner of method lirpg'
    )

    @model_validator(mode='after')
    def _a_scale_has_two_levels(self) -> 'Settings':
        if self.score_levels == 1:
            raise ValueError(
                'score_levels=1: a scale of one level says nothing of a segment; set 2 or more, '
                'or 0 for scores that are numbers'
            )
        return self

    @model_validator(mode='after')
    def _only_a_simulator_is_told_how_to_score(self) -> 'Settings':
        set_ = [n for n in ('score_missing', 'score_noise', 'score_levels') if getattr(self, n)]
        if set_ and self.scored_elsewhere:
            raise ValueError(
                f'{set_[0]}={getattr(self, set_[0]):g} with scorer={self.scorer}: it is about '
                'scores of the simulator; leave it out (simulated people have settings of their '
                'own, people.*)'
            )
        if self.scored_elsewhere and self.method == 'lirpg':
            raise ValueError(
                f'scorer={self.scorer} with method=lirpg: it learns from each step once, in its '
                'own phase, when another than the simulator has not scored it yet; set '
                'scorer=simulator'
            )
        return self

    @model_validator(mode='after')
    def _on_policy_in_lock_step(self) -> 'Settings':
        if self.method == 'lirpg' and self.overlap:
            raise ValueError(
                'overlap=True with method=lirpg: it learns on-policy, from steps under the very '
                'policy that it changes; set overlap=False'
            )
        return self

    @model_validator(mode='after')
    def _only_a_robot_is_free(self) -> 'Settings':
        if self.free and not self.on_robot:
            raise ValueError(
                f'pace=free with task={self.task}: a simulator has no pace of its own; set '
                f'pace=permitted, or the task of a robot, {ROBOT}NAME'
            )
        if self.free and self.overlap:
            raise ValueError(
                'overlap=True with pace=free: a robot at a free pace overlaps with learning '
                'anyway; set overlap=False'
            )
        return self

    @model_validator(mode='after')
    def _a_robot_is_not_evaluated_in_simulation(self) -> 'Settings':
        if not self.on_robot:
            return self
        for name, due in (('evaluate_every', 0), ('simulators', 1), ('envs', 1)):
            if getattr(self, name) != due:
                raise ValueError(
                    f'{name}={getattr(self, name)} with task={self.task}: nothing simulates the '
                    f'steps of a robot, and there is one of it; set {name}={due}'
                )
        return self

    @model_validator(mode='after')
    def _joiners_have_names_of_their_own(self) -> 'Settings':
        if not self.joiners:
            return self
        if len(set(self.joiners)) < len(self.joiners) or set(self.joiners) & set(
            self.simulator_names
        ):
            raise ValueError(
                f'joiners={list(self.joiners)}: each needs a name of its own, other than '
                f'{", ".join(self.simulator_names)}'
            )
        if self.free or self.on_robot:
            raise ValueError(
                f'joiners={list(self.joiners)} with pace={self.pace} and task={self.task}: nobody '
                'joins a robot; leave out joiners'
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
    def _critics_see_what_there_is(self) -> 'Settings':
        if not self.aggregate.critic_sees_aggregate:
            return self
        wanted = {'method': 'aggregate', 'device': 'cpu', 'relabel_steps': 0}
        for name, value in wanted.items():
            if getattr(self, name) != value:
                raise ValueError(
                    f'aggregate.critic_sees_aggregate=True with {name}={getattr(self, name)}: '
                    'what a segment is worth so far is known of whole segments, all labelled by '
                    f'one aggregator, and only SAC on the CPU can look at it; set {name}={value} '
                    'or aggregate.critic_sees_aggregate=False'
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
                f'relabel={self.relabel} with device={self.device}: SAC draws there '
                'from a generator of that device, whose draws no other node knows; set '
                'device=cpu or relabel=all'
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
        """Whether a reward method labels steps, from which the policy learner learns."""
        return self.method not in SCORE_LEARNERS

    @property
    def progress(self) -> bool:
        """Whether critics see how far a segment has come."""
        return self.aggregate.critic_sees_aggregate

    @property
    def relabels_all(self) -> bool:
        """Whether each version of the reward model labels all of the memory."""
        return self.relabel == 'all' and not self.relabel_steps

    def within(self, horizon: int) -> 'Settings':
        """The same settings for a task of this horizon: `delay` episode means that many steps."""
        return self if self.lengths.most else self.model_copy(update={'delay': horizon})

    def canonical(self) -> str:
        """The settings as JSON. Equal settings give the same text on every machine."""
        return json.dumps(self.model_dump(mode='json'), sort_keys=True, separators=(',', ':'))

    def hash(self) -> str:
        """sha256 of `canonical`."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()

    def run_spec(self, run_id: str) -> RunSpec:
        """The record that announces the run."""
        return RunSpec(
            run_id=run_id,
            protocol_version=PROTOCOL_VERSION,
            seed=self.seed,
            settings=self.canonical(),
            settings_hash=self.hash(),
        )

    def flat(self) -> dict[str, Any]:
        """Every setting by its dotted name, as in ROS parameters and errors."""
        return dict(flatten(self.model_dump()))

    def changed(self, changes: Mapping[str, Any], source: str = 'change') -> 'Settings':
        """A copy with some settings changed, given by dotted name.

        Raises:
            SettingsError: a name is unknown or a value is not allowed; `source` names its
                origin.
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
        return validate(Settings, data, source)
