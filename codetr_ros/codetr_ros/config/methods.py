"""The settings of the reward methods and policy learners, a group for each."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from codetr_ros.config.base import Group

Hidden = tuple[Annotated[int, Field(ge=1, le=65536)], ...]


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
    schedule: Literal['constant', 'cosine', 'peaked'] = Field(
        'peaked',
        description='after its warm-up from 0 the learning rate stays (constant), or falls to a '
        'tenth (cosine). Or it begins and ends at its value and peaks at ten times that after the '
        'warm-up (peaked), as in the published code of this family; the supplement is silent',
    )
    total_gradient_steps: int = Field(
        10_000,
        ge=1,
        le=10**9,
        description='gradient steps after which the schedules cosine and peaked have fallen',
    )
    first_gradient_steps: int = Field(
        100, ge=0, le=10**6, description='gradient steps after the last warm-up phase'
    )
    gradient_steps: int = Field(
        10, ge=0, le=10**6, description='gradient steps after every later phase'
    )
    tokens: Literal['pair', 'merged'] = Field(
        'pair',
        description='pair: an action and a state token per step, read at the state, as in the '
        'published code of this family; merged: one token per step, twice as fast',
    )
    head_scale: Literal['inverse', 'inverse_sqrt', 'one'] = Field(
        'inverse_sqrt',
        description='factor on the in-sequence logits: 1/d, 1/sqrt(d) (decided here) or 1 '
        '(published code)',
    )
    initialisation: Literal['gpt2', 'lecun'] = Field(
        'gpt2',
        description='initial weights: small, nearly one step at a time, as in GPT-2 (decided '
        'here), or of variance 1/inputs',
    )
    weights: Literal['attention', 'one'] = Field(
        'attention',
        description='w_t: column sums of the in-sequence attention, or fixed to 1 (an ablation)',
    )
    attention_scope: Literal['segment', 'window'] = Field(
        'segment',
        description='what in-sequence attention sees: the segment, or also the context before it',
    )
    context: Literal['segment', 'window', 'episode'] = Field(
        'window',
        description='start of the causal transformer, in training and labelling: at the segment; '
        'as many steps of the episode before it as make `window` steps with it; or up to `window` '
        'steps before it',
    )
    label: Literal['product', 'rhat'] = Field(
        'product',
        description='step reward: w_t * rhat_t, whose sum is the prediction, or rhat_t',
    )
    base: Literal['none', 'evidence'] = Field(
        'none',
        description='what the transformer learns: scores, or only what the regression of method '
        '`evidence` leaves of them; its rewards are then added as far as held-out scores ask for',
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
        description='segments or windows labelled between two checks for messages; a GPU needs '
        'thousands',
    )
    precision: Literal['float32', 'bfloat16'] = Field(
        'float32',
        description="number format of the causal layers' products; weights and heads are always "
        'float32. bfloat16 rounds to 8 bits, and is faster for large networks on processors with '
        'avx512_bf16 or amx; on a GPU it makes labels faster, gradient steps slower',
    )

    @model_validator(mode='after')
    def _heads_divide_embedding(self) -> 'CodetrSettings':
        if self.embedding % self.heads:
            raise ValueError(f'embedding={self.embedding} is not divisible by heads={self.heads}')
        return self

    @model_validator(mode='after')
    def _whole_segments_above_a_base(self) -> 'CodetrSettings':
        if self.base != 'none' and self.labelling != 'segment':
            raise ValueError(
                f'base={self.base} labels whole segments, not windows: labelling={self.labelling} '
                'must be segment'
            )
        return self


class RbtSettings(Group):
    """The settings of RBT beyond the transformer, whose settings it shares with CoDeTr (`codetr`).

    Of those, only CoDeTr uses `weights`, `label`, `context`, `base` and `attention_scope`.
    """

    state_loss_weight: float = Field(
        1.0, ge=0, le=1000, description='weight of the loss on the predicted next observation'
    )
    attention_scope: Literal['segment', 'window'] = Field(
        'window',
        description='what attention sees: the segments that fit into `codetr.window` steps, at '
        'least two, as published; or one segment',
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
    """The Markovian control: trained on segments like the transformer."""

    batch: int = Field(64, ge=1, le=65536, description='segments in a gradient step')


class AggregateSettings(PerceptronSettings):
    """What a segment is worth so far, told by three numbers carried through it."""

    batch: int = Field(64, ge=1, le=65536, description='segments in a gradient step')
    critic_sees_aggregate: bool = Field(
        False,
        description='the critics see, beside the observation, what the segment is worth so far '
        'and how much of it has passed: what a step changes of a verdict depends on both. The '
        'policy does not see them',
    )


class RrdSettings(PerceptronSettings):
    """Randomized return decomposition (Ren et al., arXiv 2111.13485)."""

    loss: Literal['biased', 'unbiased'] = Field(
        'biased',
        description='the published default, or that loss less the variance from drawing steps',
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


class DiasterSettings(PerceptronSettings):
    """Difference of sub-trajectory rewards (Lin et al., arXiv 2312.10642)."""

    width: int = Field(
        256, ge=1, le=65536, description='width of the GRU that gives runs of steps their worth'
    )
    batch: int = Field(
        64, ge=1, le=65536, description='segments in a gradient step, drawn by their lengths'
    )
    first_gradient_steps: int = Field(
        1000, ge=0, le=10**6, description='gradient steps after the last warm-up phase'
    )
    gradient_steps: int = Field(
        1000,
        ge=0,
        le=10**6,
        description='gradient steps after every later phase; published: as many as an episode '
        'has steps, in every 1000 environment steps',
    )


class LrrSettings(PerceptronSettings):
    """Likelihood reward redistribution (Xiao and Yu, arXiv 2503.17409)."""

    correlation: Literal['kernel', 'none'] = Field(
        'kernel',
        description="how the rewards of a segment's steps are related: by a kernel, as in the "
        'published version (GP-LRR), or not at all, each with a deviation of its own, as in the '
        'first',
    )
    kernel: Literal['rbf', 'matern', 'rational_quadratic'] = Field(
        'rbf', description='kernel of the Gaussian process; matern is the one of smoothness 3/2'
    )
    length_scale: float = Field(
        1.0, gt=0, le=1e6, description='length scale of the kernel at the start'
    )
    signal: float = Field(
        1.0, gt=0, le=1e6, description='deviation of step rewards from their mean at the start'
    )
    noise: float = Field(0.1, gt=0, le=1e6, description='deviation of the noise at the start')
    batch: int = Field(
        64,
        ge=1,
        le=65536,
        description='segments in a gradient step, whose time grows with the cube of their length; '
        'published: 4 whole episodes',
    )
    learning_rate: float = Field(1e-3, gt=0, le=1, description='AdamW learning rate')
    gradient_norm: float = Field(
        1.0, gt=0, le=1e6, description='largest norm of a gradient; longer ones are shortened'
    )


class MilLstmSettings(PerceptronSettings):
    """The recurrent multiple-instance model (Early et al., arXiv 2205.15367)."""

    hidden: Hidden = Field(
        (64, 32, 32),
        min_length=1,
        max_length=8,
        description='widths of the layers that embed a step',
    )
    space: Literal['csc', 'instance', 'embedding'] = Field(
        'csc',
        description="what the head reads: the LSTM's state beside the embedded step "
        '(concatenated skip connections), or its state alone, or its last state, whose growth '
        'step by step is then the reward',
    )
    width: int = Field(2, ge=1, le=65536, description='width of the LSTM')
    head: Hidden = Field(
        (32, 16), min_length=1, max_length=8, description='hidden layer widths of the head'
    )
    dropout: float = Field(0.1, ge=0, lt=1, description='dropout after each hidden layer')
    batch: int = Field(64, ge=1, le=65536, description='segments in a gradient step')
    learning_rate: float = Field(5e-4, gt=0, le=1, description='AdamW learning rate')


class EvidenceSettings(Group):
    """Step rewards by Bayesian regression on scores."""

    link: Literal['known', 'choose'] = Field(
        'known',
        description='how step rewards make a score: as `composite` and `beta` state, or as the '
        'scores themselves let infer',
    )
    score_scale: Literal['auto', 'numbers', 'ordinal'] = Field(
        'auto',
        description='whether scores are numbers, or verdicts such as one to five stars of which '
        'only the order means anything: their scale is then learnt too; auto: ordinal where '
        '`score_levels` are set, and where others than the simulator give few different scores',
    )
    terminal_feature: bool = Field(
        False,
        description='steps that led to a terminal state have a feature of their own: rewards '
        'often jump there, as where a robot falls. It helps `link: choose` to name the kind of '
        'score',
    )
    caution: float = Field(
        1.0,
        ge=0,
        le=100,
        description='steps of segments without a score: how many standard deviations a reward '
        'lies below what is expected, as far as less is known of it than of the newest steps with '
        'a score',
    )
    scores: int = Field(
        8192,
        ge=2,
        le=10**6,
        description='scores to learn from: all, or the newest half and as many of the older ones; '
        'each takes some 6 KB',
    )
    steps: int = Field(
        32_768,
        ge=1,
        le=10**8,
        description='steps to learn from where a score is no function of a sum, or is not known '
        'to be: each takes some 3 KB',
    )
    scale_scores: int = Field(
        300,
        ge=2,
        le=10_000,
        description='scores, drawn from these, by which the scales of features and noise are '
        'learnt',
    )


class SacSettings(Group):
    """Soft actor-critic as in jaxrl."""

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
        description='target entropy in units of the action size: -0.5 as in jaxrl, often -1 '
        'elsewhere',
    )
    updates_per_step: float = Field(1.0, ge=0, le=100, description='updates per environment step')
    burst: int = Field(50, ge=1, le=100_000, description='updates between two checks for messages')
    compile: bool = Field(
        True,
        description='compile the update for this processor, or the GPU of `device`. It is faster, '
        'but needs a C++ compiler; the first start takes about half a minute longer, later ones '
        'some seconds (compiled code is kept in ~/.cache/codetr_ros/torch)',
    )


class HcSettings(Group):
    """The critic of method `hc` (Han et al., arXiv 2106.11854); it takes the rest from `sac`."""

    history: Literal['singleton', 'recurrent'] = Field(
        'recurrent',
        description='value of the history: a sum over its steps, or that of a GRU over them',
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
        description='segments from which the sac.batch steps of an update are drawn (decided '
        'here)',
    )


class LirpgSettings(Group):
    """PPO with a learnt intrinsic reward and its constants (Zheng et al., arXiv 1804.06459)."""

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
        1.0, ge=0, le=1e6, description='weight of the intrinsic reward for the policy'
    )
    extrinsic_coefficient: float = Field(
        0.0, ge=0, le=1e6, description='weight of the scores for the policy'
    )
    value_coefficient: float = Field(0.5, ge=0, le=1e6, description='weight of the value losses')
    gradient_norm: float = Field(
        0.5, gt=0, le=1e6, description='largest norm of a gradient; longer ones are shortened'
    )
