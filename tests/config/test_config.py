import math
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from codetr_ros import config
from codetr_ros.config import Settings, SettingsError


@pytest.mark.parametrize('name', config.PRESETS)
def test_every_preset_is_a_valid_configuration(name: str) -> None:
    assert isinstance(config.load(name), Settings)


def test_the_paper_preset_is_the_default_of_every_setting() -> None:
    paper, default = config.load('paper').flat(), Settings().flat()  # type: ignore[call-arg]

    assert {
        name: (paper[name], default[name]) for name in paper if paper[name] != default[name]
    } == {}


def test_the_paper_preset_spells_out_every_setting_of_every_method() -> None:
    text = resources.files('codetr_ros.config.presets').joinpath('paper.yaml').read_text()
    said = dict(config.flatten(yaml.safe_load(text)))
    assert [
        name
        for name in Settings().flat()
        if '.' in name and name not in said and not name.startswith('people.')
    ] == []  # type: ignore[call-arg]


def test_the_papers_table_is_what_the_paper_preset_says() -> None:
    paper = config.load('paper')

    assert (paper.codetr.layers, paper.codetr.heads, paper.codetr.embedding) == (3, 4, 256)
    assert (paper.codetr.batch, paper.codetr.learning_rate) == (64, 5e-5)
    assert (paper.codetr.weight_decay, paper.codetr.dropout) == (1e-4, 0.1)
    assert (paper.codetr.window, paper.codetr.context) == (100, 'window')
    assert (paper.codetr.first_gradient_steps, paper.codetr.gradient_steps) == (100, 10)
    assert (paper.warmup_steps, paper.steps, paper.evaluate_every) == (10_000, 1_000_000, 5000)
    assert (paper.sac.hidden, paper.sac.batch) == ((256, 256), 256)


@pytest.mark.parametrize(
    ('name', 'value', 'said'),
    [
        ('delay', 0, 'delay = 0: a segment has 1 to 100000 steps'),
        ('steps', -5, 'steps = -5: Input should be greater than or equal to 1'),
        ('method', 'magic', "method = 'magic': Input should be 'codetr', 'none', 'rbt', 'rrd'"),
        ('composite', 'mean', "composite = 'mean': Input should be 'sum'"),
        ('method', 'codtr', "'ones' (did you mean codetr?)"),
        ('composite', 'sqare_sum', '(did you mean square_sum?)'),
        ('envs', 0, 'envs = 0: Input should be greater than or equal to 1'),
        ('envs', 65, 'envs = 65: Input should be less than or equal to 64'),
        ('sac.discount', 1.5, 'sac.discount = 1.5: Input should be less than or equal to 1'),
        ('sac.hidden', (64, -1, 64), 'sac.hidden'),
        ('beta', math.inf, 'beta = inf: Input should be'),
        ('beta', math.nan, 'beta = nan: Input should be a finite number'),
        ('seed', 2**31, 'seed = 2147483648: Input should be less than or equal to 2147483647'),
        ('overlap', 'perhaps', "overlap = 'perhaps': Input should be a valid boolean"),
        ('device', 'gpu', "device = 'gpu': must be cpu, or a GPU: cuda, or cuda and its number"),
        ('reward_device', 'cuda:', "reward_device = 'cuda:': must be cpu, or a GPU: cuda, or"),
        ('codetr.heads', 5, 'embedding=64 is not divisible by heads=5'),
        ('task', '', "task = '': String should have at least 1 character"),
    ],
)
def test_a_value_that_is_not_allowed_is_refused_with_its_name_and_what_is(
    name: str, value: Any, said: str
) -> None:
    with pytest.raises(SettingsError) as refused:
        config.load('quick').changed({name: value}, 'here')

    assert str(refused.value).startswith('here: ')
    assert said in str(refused.value)


@pytest.mark.parametrize('name', ['dely', 'codetr.layer', 'sac.hidden.first', 'codetr.', ''])
def test_an_unknown_setting_is_refused_and_the_known_ones_are_named(name: str) -> None:
    with pytest.raises(SettingsError) as refused:
        config.load('quick').changed({name: 1}, 'node learner')

    assert f'node learner: there is no setting {name!r} (value 1)' in str(refused.value)
    assert 'codetr.layers' in str(refused.value)


@pytest.mark.parametrize(
    ('others', 'said'),
    [
        ({'method': 'codetr'}, 'critic_sees_aggregate=True with method=codetr: what a segment'),
        ({'device': 'cuda'}, 'critic_sees_aggregate=True with device=cuda: what a segment'),
        ({'relabel_steps': 7}, 'critic_sees_aggregate=True with relabel_steps=7: what a segment'),
    ],
)
def test_critics_see_only_what_one_aggregator_made(others: dict[str, Any], said: str) -> None:
    changes = {'method': 'aggregate', 'aggregate.critic_sees_aggregate': True}
    with pytest.raises(SettingsError) as refused:
        config.load('quick').changed(changes | others)

    assert said in str(refused.value)


@pytest.mark.parametrize(
    ('others', 'said'),
    [
        ({'method': 'hc'}, 'relabel=drawn with method=hc: its policy learner draws no labelled'),
        ({'method': 'lirpg'}, 'relabel=drawn with method=lirpg: its policy learner draws no'),
        ({'device': 'cuda'}, 'relabel=drawn with device=cuda: SAC draws there from a generator'),
        ({'relabel_steps': 7}, 'relabel=drawn with relabel_steps=7: one labels again all that'),
    ],
)
def test_drawn_steps_are_not_to_be_labelled_where_they_are_unknown_or_others_are_asked_for(
    others: dict[str, Any], said: str
) -> None:
    with pytest.raises(SettingsError) as refused:
        config.load('quick').changed({'relabel': 'drawn', **others}, 'here')

    assert said in str(refused.value)
    assert str(refused.value).endswith('relabel=all')
    assert config.load('quick').changed({'relabel': 'drawn'}).relabel == 'drawn'


def test_every_fault_of_a_file_is_named_at_once(tmp_path: Path) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text('delay: 0\nstepz: 3\ncodetr: {layers: many}\n')

    with pytest.raises(SettingsError) as refused:
        config.load(str(file))

    lines = str(refused.value).splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f'{file}: ') for line in lines)
    assert f'{file}: stepz = 3: there is no such setting (did you mean steps?)' in lines


def test_a_key_that_is_no_text_is_no_setting(tmp_path: Path) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text('5: 6\n')

    with pytest.raises(SettingsError) as refused:
        config.load(str(file))

    assert str(refused.value) == f'{file}: 5: there is no such setting'


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('- a\n', 'must hold a mapping of settings, not list'),
        ('', 'must hold a mapping of settings, not NoneType'),
        ('delay: [', 'is not YAML'),
    ],
)
def test_a_file_that_holds_no_settings_is_refused(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text(text)

    with pytest.raises(SettingsError, match=said):
        config.load(str(file))


def test_neither_preset_nor_file_is_said_with_the_presets() -> None:
    with pytest.raises(
        SettingsError, match=r"'fast' is neither a preset \(quick, cpu, paper\) nor a"
    ):
        config.load('fast')


def test_a_file_keeps_the_papers_values_where_it_is_silent(tmp_path: Path) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text('delay: 50\ncodetr: {layers: 1}\n')

    mine = config.load(str(file))

    assert mine == Settings().changed({'delay': 50, 'codetr.layers': 1})  # type: ignore[call-arg]


def test_the_canonical_form_gives_the_same_settings_and_hash() -> None:
    settings = config.load('cpu')

    again = config.from_canonical(settings.canonical(), 'learner')

    assert again == settings
    assert again.hash() == settings.hash()
    assert settings.changed({'seed': 1}).hash() != settings.hash()


def test_settings_of_a_run_that_are_not_settings_are_refused_with_their_source() -> None:
    with pytest.raises(SettingsError, match='node learner: the text of the settings is not JSON'):
        config.from_canonical('{', 'node learner')
    with pytest.raises(SettingsError, match='node learner: delay = 0'):
        config.from_canonical('{"delay": 0}', 'node learner')


def test_settings_do_not_change() -> None:
    settings = config.load('quick')

    with pytest.raises(ValueError, match='frozen'):
        settings.delay = 3  # type: ignore[misc]


def test_every_setting_says_what_it_is_and_every_number_has_a_range() -> None:
    groups = {type(value) for _, value in Settings() if isinstance(value, config.Group)}
    assert config.CodetrSettings in groups
    for group in (Settings, *groups):
        for name, field in group.model_fields.items():
            assert field.description, name
            if field.annotation in (int, float, float | None):
                bounds = {type(m).__name__ for m in field.metadata}
                assert bounds & {'Ge', 'Gt'}, f'{name} has no lower bound'
                assert bounds & {'Le', 'Lt'}, f'{name} has no upper bound'


def settings(**changes: Any) -> Settings:
    return config.load('quick').changed(changes)


@hypothesis_settings(derandomize=True, deadline=None)
@given(steps=st.integers(1, 50_000), phase=st.integers(1, 7000), warmup=st.integers(1, 60_000))
def test_phases_divide_all_steps_of_a_run_and_no_more(steps: int, phase: int, warmup: int) -> None:
    s = settings(steps=steps, phase_steps=phase, warmup_steps=warmup)

    sizes = [s.steps_of(k) for k in range(s.phases)]

    assert sum(sizes) == steps
    assert all(0 < n <= phase for n in sizes)
    assert s.steps_of(s.phases) == 0
    assert s.steps_after(s.phases - 1) == steps
    assert s.steps_after(-1) == 0
    assert 1 <= s.warmup_phases <= s.phases


@hypothesis_settings(derandomize=True, deadline=None)
@given(
    steps=st.integers(1, 30_000),
    phase=st.integers(100, 3000),
    warmup=st.integers(1, 10_000),
    every=st.integers(50, 9000),
)
def test_the_last_policy_is_always_evaluated_and_no_multiple_is_left_out(
    steps: int, phase: int, warmup: int, every: int
) -> None:
    s = settings(steps=steps, phase_steps=phase, warmup_steps=warmup, evaluate_every=every)

    versions = [v for v in range(-1, s.phases) if s.evaluated(v)]

    assert versions[-1] == s.phases - 1
    assert versions[0] >= s.warmup_phases - 1, 'random policies are not evaluated again'
    for multiple in range(every, steps + 1, every):
        first = -(-multiple // phase) - 1  # after this version, as many steps were taken
        assert first in versions or first < s.warmup_phases - 1


def test_nothing_is_evaluated_where_it_is_switched_off() -> None:
    s = settings(evaluate_every=0)

    assert not any(s.evaluated(v) for v in range(-1, s.phases))


def test_evaluations_of_the_quick_preset_come_every_1000_steps() -> None:
    s = config.load('quick')

    evaluated = [s.steps_after(v) for v in range(s.phases) if s.evaluated(v)]
    assert evaluated == list(range(1000, 8001, 1000))


def test_the_sources_of_a_run_are_the_environments_of_its_simulators() -> None:
    one = config.load('quick').changed({'simulators': 2})
    assert [one.sources_of(name) for name in one.simulator_names] == [('sim',), ('sim_2',)]
    many = one.changed({'envs': 3})
    sources = [source for name in many.simulator_names for source in many.sources_of(name)]
    assert sources == ['sim-1', 'sim-2', 'sim-3', 'sim_2-1', 'sim_2-2', 'sim_2-3']
    assert [many.simulator_of(source) for source in sources] == ['sim'] * 3 + ['sim_2'] * 3
    assert one.simulator_of('a-1') == 'a-1'  # a robot may be called so
    for settings in (one, many):
        assert len(settings.shares_of(0)) == settings.source_count == 2 * settings.envs
        assert sum(settings.shares_of(0)) == settings.phase_steps
    assert many.shares_of(0) == [167, 167, 167, 167, 166, 166]


@pytest.mark.parametrize('method', config.SCORE_LEARNERS)
def test_a_gpu_is_refused_where_the_policy_learner_has_no_use_for_it(method: str) -> None:
    with pytest.raises(SettingsError, match=f'device=cuda with method={method}: .*device=cpu'):
        settings(method=method, device='cuda')
    assert settings(method='uniform', device='cuda:1').device == 'cuda:1'


@pytest.mark.parametrize('preset', config.PRESETS)
def test_the_nearest_preset_is_that_from_which_fewest_settings_differ(preset: str) -> None:
    changes = {'task': 'Hopper-v5', 'seed': 3, 'sac.hidden': (7, 7)}
    mine = config.load(preset).changed(changes).model_dump(mode='json')

    assert config.nearest(mine) == preset
    there = config.load(preset).flat()
    assert config.differences(mine, preset) == [
        (name, list(there[name]) if name == 'sac.hidden' else there[name], value)
        for name, value in (('task', 'Hopper-v5'), ('seed', 3), ('sac.hidden', [7, 7]))
    ]


def test_a_setting_that_a_preset_does_not_know_differs_from_it() -> None:
    assert config.differences({'sac': {'of_old': None}}, 'cpu') == [('sac.of_old', None, None)]


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'pace': 'free'}, 'pace=free with task=Ant-v4: a simulator has no pace of its own'),
        (
            {'pace': 'free', 'task': 'robot/arm', 'evaluate_every': 0, 'overlap': True},
            'overlap=True with pace=free',
        ),
        ({'task': 'robot/arm'}, 'evaluate_every=5000 with task=robot/arm: nothing simulates'),
        (
            {'task': 'robot/arm', 'evaluate_every': 0, 'simulators': 2},
            'simulators=2 with task=robot/arm',
        ),
    ],
)
def test_only_a_robot_is_free_and_nothing_simulates_it(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        Settings().changed(changes)  # type: ignore[call-arg]


def test_a_free_robot_may_be_eight_phases_ahead_of_what_was_learnt_from() -> None:
    robot = Settings().changed({'task': 'robot/arm', 'evaluate_every': 0})  # type: ignore[call-arg]
    assert (robot.ahead, robot.lag) == (1, 1)
    assert (robot.changed({'pace': 'free'}).ahead, robot.roles.get('evaluate')) == (8, None)
