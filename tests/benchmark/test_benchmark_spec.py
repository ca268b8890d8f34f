from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from codetr_ros import config
from codetr_ros.benchmark import spec
from codetr_ros.benchmark.spec import BenchmarkError

SMALL: dict[str, Any] = {
    'methods': ['codetr', 'none'],
    'tasks': ['InvertedPendulum-v5'],
    'composites': ['sum', 'max'],
    'delays': [5, 10],
    'seeds': [0, 1],
    'steps': 300,
}


def write(folder: Path, **changes: Any) -> Path:
    path = folder / 'spec.yaml'
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return path


def test_the_cells_are_all_combinations_with_readable_names_seed_by_seed(tmp_path: Path) -> None:
    cells = spec.load(write(tmp_path)).cells

    assert len({cell.name for cell in cells}) == len(cells) == 2 * 1 * 2 * 2 * 2
    assert cells[0].name == 'InvertedPendulum-v5_sum_5_codetr_seed0'
    assert [cell.settings.seed for cell in cells] == [0] * 8 + [1] * 8
    last = cells[-1].settings
    assert (last.method, last.composite, last.delay, last.steps) == ('none', 'max', 10, 300)


def test_delays_may_be_drawn_or_whole_episodes_and_scores_inexact(tmp_path: Path) -> None:
    path = tmp_path / 'spec.yaml'
    keys = {**SMALL, 'delays': ['10-50', 'episode', 5], 'config': {'score_missing': 0.3}}
    path.write_text(yaml.safe_dump(keys).replace('10-50', '10:50'))  # without quotes
    made = spec.load(path)
    cells = {cell.settings.delay: cell for cell in made.cells if cell.settings.seed == 0}

    assert list(cells) == ['10:50', 'episode', 5]
    assert cells['10:50'].name == 'InvertedPendulum-v5_max_10-50_none_seed0'
    assert cells['episode'].name == 'InvertedPendulum-v5_max_episode_none_seed0'
    assert all(cell.settings.score_missing == 0.3 for cell in made.cells)
    again = tmp_path / 'again.yaml'
    again.write_text(made.to_yaml())
    assert spec.load(again).cells == made.cells


def test_without_config_a_cell_has_the_settings_of_the_quick_preset(tmp_path: Path) -> None:
    cell = spec.load(write(tmp_path)).cells[0]

    named = {name: cell.settings.flat()[name] for name in ('task', 'steps', 'delay')}
    assert cell.settings == config.load('quick').changed(named)


def test_config_names_a_preset_or_a_file_beside_the_spec_and_changes_it(tmp_path: Path) -> None:
    (tmp_path / 'mine.yaml').write_text('delay: 99\ncodetr: {layers: 3}\n')
    changes = {'base': 'mine.yaml', 'sac': {'batch': 64}, 'codetr.embedding': 8, 'threads': 2}

    settings = spec.load(write(tmp_path, config=changes)).cells[0].settings

    assert (settings.codetr.layers, settings.codetr.embedding) == (3, 8)
    assert (settings.sac.batch, settings.threads, settings.delay) == (64, 2, 5)
    cpu = spec.load(write(tmp_path, config='cpu')).cells[0].settings
    assert cpu.codetr == config.load('cpu').codetr


def test_the_oracle_needs_no_quotes_although_yaml_reads_true(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(path.read_text().replace('- codetr', '- true'))

    assert spec.load(path).cells[0].settings.method == 'true'


def test_the_spec_with_every_setting_spelt_out_makes_the_same_cells(tmp_path: Path) -> None:
    made = spec.load(write(tmp_path, methods=['true', 'none'], config={'sac.hidden': [8, 8]}))

    again = tmp_path / 'again.yaml'
    again.write_text(made.to_yaml())

    assert spec.load(again).cells == made.cells


@pytest.mark.parametrize('method', get_args(config.Settings.model_fields['method'].annotation))
def test_every_method_can_be_benchmarked(method: str, tmp_path: Path) -> None:
    assert spec.load(write(tmp_path, methods=[method])).cells[0].settings.method == method


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'methods': ['codetr', 'magic']}, "methods.1 = 'magic': Input should be 'codetr'"),
        ({'methods': []}, 'methods = []'),
        ({'delays': 25}, 'delays = 25: Input should be a valid'),
        ({'seeds': [0, 0]}, '0 twice'),
        ({'steps': 0}, 'steps = 0'),
        (
            {'delay': [5]},
            'there is no key delay (value [5]) (did you mean delays?). Keys are: methods, tasks',
        ),
        ({'tasks': ['Ant-v99']}, "there is no task 'Ant-v99'"),
        ({'delays': [2000]}, 'cell InvertedPendulum-v5_sum_2000_codetr_seed0: delay = 2000'),
        ({'config': 'slow'}, "config.base = 'slow': neither a preset (quick, cpu, paper)"),
        ({'config': {'sac.batches': 3}}, "config: there is no setting 'sac.batches' (value 3)"),
        ({'config': {'sac.batch': 0}}, 'config: sac.batch = 0'),
        ({'config': {'delay': 5}}, 'config.delay = 5: the key delays of the spec decides it'),
        ({'config': {'evaluate_every': 0}}, 'config.evaluate_every = 0'),
        ({'config': {'base': 3}}, 'config.base = 3'),
    ],
)
def test_a_spec_that_cannot_be_run_is_refused_by_key_value_and_file(
    changes: dict[str, Any], said: str, tmp_path: Path
) -> None:
    path = write(tmp_path, **changes)

    with pytest.raises(BenchmarkError) as refused:
        spec.load(path)

    assert said in str(refused.value)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('- a\n', 'not list'),
        ('a: [\n', 'is not YAML'),
        (None, 'cannot be read: No such file'),
        ("5: 'x'\n", "there is no key 5 .value 'x'."),
        ('~: 1\ndelay: 2\n', 'there is no key None, delay .value 1.'),
        ('2026-01-01: 1\n', 'there is no key 2026-01-01 .value 1.'),
    ],
)
def test_a_file_that_holds_no_spec_is_refused(text: str | None, said: str, tmp_path: Path) -> None:
    path = tmp_path / 'spec.yaml'
    if text is not None:
        path.write_text(text)

    with pytest.raises(BenchmarkError, match=said):
        spec.load(path)


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    path = tmp_path / 'spec.yaml'
    path.write_text('methods: [none]\n')

    with pytest.raises(BenchmarkError, match='tasks: Field required'):
        spec.load(path)
