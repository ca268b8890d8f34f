"""How many threads the cells of a benchmark get where the spec leaves them to the machine."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from codetr_ros.benchmark import spec
from codetr_ros.benchmark.folder import Folder
from codetr_ros.benchmark.run import settled
from codetr_ros.benchmark.spec import BenchmarkError, Spec
from codetr_ros.system import processors

WIDE: dict[str, Any] = {'base': 'cpu', 'evaluate_every': 1000}
CORES = 4


@pytest.fixture(autouse=True)
def _four_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processors, 'count', lambda: CORES)


def loaded(path: Path, config: dict[str, Any], **keys: Any) -> Spec:
    lists = {
        'methods': ['codetr', 'none'],
        'tasks': ['InvertedPendulum-v5'],
        'composites': ['sum'],
        'delays': [25],
        'seeds': [0],
        'steps': 3000,
    }
    path.write_text(yaml.safe_dump({**lists, 'config': config, **keys}))
    return spec.load(path)


def threads(made: Spec) -> set[int | str]:
    return {made.base.threads, *(cell.settings.threads for cell in made.cells)}


def test_cells_side_by_side_share_the_cores(tmp_path: Path) -> None:
    made, folder = loaded(tmp_path / 'spec.yaml', WIDE), Folder(tmp_path / 'out')

    assert threads(made) == {'auto'}
    shared = {
        workers: threads(settled(made, folder, workers, None)) for workers in (1, 2, 3, 4, 9)
    }
    assert shared == {1: {4}, 2: {2}, 3: {1}, 4: {1}, 9: {1}}
    assert threads(settled(made, folder, 1, 'local')) == {1}, 'Ray finds room for each by itself'


def test_all_cells_get_what_the_least_of_them_can_use(tmp_path: Path) -> None:
    methods = {'methods': ['codetr', 'hc']}
    made = loaded(tmp_path / 'spec.yaml', WIDE, **methods)
    assert threads(settled(made, Folder(tmp_path / 'out'), 1, None)) == {1}


def test_a_number_in_the_spec_decides_by_itself(tmp_path: Path) -> None:
    made = loaded(tmp_path / 'spec.yaml', WIDE | {'threads': 3})
    assert settled(made, Folder(tmp_path / 'out'), 2, None) == made


def test_a_folder_keeps_its_number_however_many_workers_go_on_with_it(tmp_path: Path) -> None:
    made, folder = loaded(tmp_path / 'spec.yaml', WIDE), Folder(tmp_path / 'out')
    folder.path.mkdir()
    first = settled(made, folder, 2, None)
    folder.prepare(first, {})

    again = settled(made, folder, 1, None)

    assert again == first
    folder.check(again)


def test_a_spec_in_the_folder_that_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    made, folder = loaded(tmp_path / 'spec.yaml', WIDE), Folder(tmp_path / 'out')
    folder.path.mkdir()
    for damaged in ('[', '- 1'):
        (folder.path / 'spec.yaml').write_text(damaged)
        with pytest.raises(BenchmarkError, match=r'out/spec\.yaml'):
            settled(made, folder, 1, None)
