"""Benchmarks as users run them: the command, in a process of its own, with tiny cells."""

import json
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from codetr_ros import cli
from codetr_ros.benchmark.folder import Folder

TINY: dict[str, Any] = {
    'methods': ['none'],
    'tasks': ['InvertedPendulum-v5'],
    'composites': ['sum'],
    'delays': [5],
    'seeds': [0, 1],
    'steps': 200,
    'config': {
        'phase_steps': 100,
        'warmup_steps': 100,
        'evaluate_every': 100,
        'evaluate_episodes': 1,
        'sac': {'hidden': [8], 'batch': 8},
        'codetr': {'layers': 1, 'embedding': 8, 'first_gradient_steps': 2, 'gradient_steps': 1},
    },
}
CELLS = [f'InvertedPendulum-v5_sum_5_none_seed{seed}' for seed in (0, 1)]
DEADLINE = 120.0


def write(path: Path, **changes: Any) -> Path:
    path.write_text(yaml.safe_dump({**TINY, **changes}))
    return path


def start(spec: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, '-m', 'codetr_ros.cli', 'benchmark', 'run', str(spec)]
    return subprocess.Popen(
        [*command, '--out', str(out), *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1', 'COLUMNS': '80'},
    )


def run(spec: Path, out: Path, *more: str) -> tuple[int, str]:
    process = start(spec, out, *more)
    said, _ = process.communicate(timeout=DEADLINE)
    return process.returncode, said


def wait(condition: Callable[[], Any], what: str) -> Any:
    """What `condition` returns, as soon as that is true."""
    began = time.monotonic()
    while not (found := condition()):
        assert time.monotonic() - began < DEADLINE, f'{what} did not happen'
        time.sleep(0.01)
    return found


def children(process: subprocess.Popen[str]) -> list[int]:
    """Processes that it has started and that have not ended."""
    path = Path(f'/proc/{process.pid}/task/{process.pid}/children')
    return [int(pid) for pid in path.read_text().split()]


def gone(pid: int) -> bool:
    """Whether a process has ended, waited for or not."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] == 'Z'
    except OSError:
        return True


def attempts(out: Path) -> list[str]:
    folder = Folder(out).attempts
    return sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []


def begun(out: Path, cell: str) -> bool:
    """Whether the cell's process has come as far as making its folder."""
    return any(name.startswith(cell) and not name.endswith('.log') for name in attempts(out))


@pytest.mark.slow
def test_after_sigkill_finished_cells_are_kept_and_unfinished_ones_begin_again(
    tmp_path: Path,
) -> None:
    spec, out = write(tmp_path / 'spec.yaml'), tmp_path / 'out'
    first = out / CELLS[0] / 'summary.json'
    process = start(spec, out)
    wait(lambda: first.is_file() and begun(out, CELLS[1]), 'the second cell')
    orphans = children(process)
    process.kill()
    process.communicate()
    assert not (out / CELLS[1]).exists()
    wait(lambda: all(gone(pid) for pid in orphans), "the end of the killed runner's cells")
    before = first.stat()
    left = attempts(out)
    assert left

    code, said = run(spec, out)

    assert code == 0, said
    assert '1 finished before' in said
    assert 'runs that an earlier runner left unfinished were removed' in said
    assert attempts(out) == []
    after = first.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    for cell in CELLS:
        summary = json.loads((out / cell / 'summary.json').read_text())
        assert summary['steps'] == 200
        assert summary['settings_hash'] == Folder(out).index()['cells'][cell]['settings_hash']
    assert len(Folder(out).index()['sessions']) == 2


@pytest.mark.slow
def test_a_cell_that_is_killed_is_kept_as_failed_and_run_again_on_demand(tmp_path: Path) -> None:
    spec, out = write(tmp_path / 'spec.yaml'), tmp_path / 'out'
    process = start(spec, out)
    wait(lambda: begun(out, CELLS[0]), 'the first cell')
    os.kill(children(process)[0], signal.SIGKILL)
    said, _ = process.communicate(timeout=DEADLINE)

    assert process.returncode == 1
    assert f'FAILED: {CELLS[0]}' in said
    ending = json.loads((out / 'cells' / f'{CELLS[0]}.json').read_text())
    assert ending['error'] == 'ended by SIGKILL'
    assert ending['exit_code'] == -9
    assert '$ ' in ending['log']
    assert Folder(out).summary(CELLS[1]) is not None

    code, said = run(spec, out)
    assert code == 1, 'what failed before is not forgotten'
    assert '1 finished before, 1 failed before, 0 to be run' in said
    assert f'{CELLS[0]}: ended by SIGKILL' in said

    code, said = run(spec, out, '--retry-failed')
    assert code == 0, said
    assert json.loads((out / 'cells' / f'{CELLS[0]}.json').read_text())['error'] is None
    assert (out / 'aside' / f'{CELLS[0]}.1').is_dir()


@pytest.mark.slow
def test_ctrl_c_ends_a_benchmark_at_once_and_leaves_nothing_half_done(tmp_path: Path) -> None:
    spec, out = write(tmp_path / 'spec.yaml', steps=10**6), tmp_path / 'out'
    process = start(spec, out, '--workers', '2')
    wait(lambda: all(begun(out, cell) for cell in CELLS), 'both cells')
    cells = children(process)
    assert len(cells) == 2

    code, said = run(spec, out)
    assert code == 2
    assert 'another `codetr benchmark run` is at work there' in said

    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=DEADLINE)

    assert process.returncode == 130
    assert 'stopped: what has ended is kept' in said
    assert all(gone(pid) for pid in cells)
    assert attempts(out) == []
    assert not any((out / cell).exists() for cell in CELLS)


def test_a_folder_of_another_spec_is_refused_unless_cells_are_only_added(tmp_path: Path) -> None:
    out = tmp_path / 'out'
    made = _prepared(out, write(tmp_path / 'spec.yaml'))
    before = made.path.joinpath('benchmark.json').read_bytes()

    for changes, said in (
        ({'seeds': [0]}, f'1 cells that this one lacks ({CELLS[1]})'),
        ({'steps': 300}, 'steps: 200 there, 300 here'),
        ({'config': {**TINY['config'], 'sac': {'batch': 9}}}, 'sac.batch: 8 there, 9 here'),
    ):
        code, shown = run(write(tmp_path / 'other.yaml', **changes), out)
        assert code == 2
        assert 'was made by another spec' in shown
        assert said in ' '.join(shown.split())
    assert made.path.joinpath('benchmark.json').read_bytes() == before

    _prepared(out, write(tmp_path / 'more.yaml', seeds=[1, 0, 2]))
    assert len(made.index()['cells']) == 3


def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path) -> None:
    out = tmp_path / 'out'
    out.mkdir()
    (out / 'thesis.tex').touch()

    code, said = run(write(tmp_path / 'spec.yaml'), out)

    assert code == 2
    assert 'exists and is not empty (thesis.tex)' in ' '.join(said.split())


def test_no_workers_are_refused(tmp_path: Path) -> None:
    code, said = run(write(tmp_path / 'spec.yaml'), tmp_path / 'out', '--workers', '0')

    assert code == 2
    assert '--workers 0: at least 1' in said


def _prepared(out: Path, path: Path) -> Folder:
    from codetr_ros.benchmark import spec

    made, folder = spec.load(path), Folder(out)
    folder.check(made)
    folder.path.mkdir(exist_ok=True)
    folder.prepare(made, {})
    return folder


@pytest.mark.slow
def test_on_ray_every_cell_ends_exactly_once_although_a_node_dies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in RAY.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('RAY_AUTH_TOKEN_PATH', str(tmp_path / 'token'))
    (tmp_path / 'token').write_text(secrets.token_hex(32))
    cluster_utils = pytest.importorskip('ray.cluster_utils', reason='needs requirements-ray.txt')
    spec, out = write(tmp_path / 'spec.yaml', steps=600, seeds=[0, 1, 2]), tmp_path / 'out'
    cells = [f'InvertedPendulum-v5_sum_5_none_seed{seed}' for seed in (0, 1, 2)]
    cluster = cluster_utils.Cluster(
        initialize_head=True,
        head_node_args={'num_cpus': 1, 'include_dashboard': False},
    )
    try:
        doomed = cluster.add_node(num_cpus=1)
        process = start(spec, out, '--ray', cluster.address)
        running = wait(lambda: two_run(out, cells), 'a cell on each node')

        cluster.remove_node(doomed, allow_graceful=False)

        again = wait(lambda: begun_again(out, running), 'a second attempt')
        said, _ = process.communicate(timeout=240)
    finally:
        cluster.shutdown()
    assert process.returncode == 0, said
    assert again in said
    assert attempts(out) == []
    assert not (out / 'aside').exists(), 'nothing was finished twice'
    for cell in cells:
        summary = json.loads((out / cell / 'summary.json').read_text())
        assert (summary['steps'], summary['failure']) == (600, None)
        assert said.count(f'done: {cell} ') == 1


RAY = {
    'RAY_USAGE_STATS_ENABLED': '0',
    # a node that says nothing for two seconds is dead
    'RAY_health_check_initial_delay_ms': '1000',
    'RAY_health_check_period_ms': '1000',
    'RAY_health_check_failure_threshold': '2',
}


def two_run(out: Path, cells: list[str]) -> list[str]:
    """The attempts at two cells, once both have begun; else nothing."""
    running = [cell for cell in cells if begun(out, cell)]
    return attempts(out) if len(running) == 2 else []


def begun_again(out: Path, before: list[str]) -> str | None:
    """A cell of which there is an attempt beside the one before."""
    cells = {name.split('.')[0] for name in before}
    for name in attempts(out):
        cell = name.split('.')[0]
        if cell in cells and name.removesuffix('.log') not in {
            other.removesuffix('.log') for other in before
        }:
            return cell
    return None


@pytest.mark.parametrize('address', ['127.0.0.1:1', 'ray://127.0.0.1:1', 'nowhere'])
def test_without_a_cluster_at_the_address_ray_is_refused(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('ray', reason='needs requirements-ray.txt')
    spec, out = write(tmp_path / 'spec.yaml'), tmp_path / 'out'

    assert cli.main(['benchmark', 'run', str(spec), '--out', str(out), '--ray', address]) == 2

    assert f'--ray {address}: the cluster cannot be reached' in capsys.readouterr().err
    assert not out.exists()


def test_ray_that_is_not_installed_is_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, 'ray', None)
    spec, out = write(tmp_path / 'spec.yaml'), tmp_path / 'out'

    assert cli.main(['benchmark', 'run', str(spec), '--out', str(out), '--ray', 'local']) == 2

    assert 'pip install -r requirements-ray.txt' in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_nothing_but_a_run_on_ray_imports_ray() -> None:
    program = (
        'import sys\nfrom codetr_ros.benchmark import overview, ray_pool, report, run, spec\n'
        "assert 'ray' not in sys.modules"
    )
    subprocess.run([sys.executable, '-c', program], check=True)
