"""Algorithm 1 with plain calls instead of topics: the same cores, in the same order, in one
process.

A run over topics with the same seed, pace and thread count ends with the same weights. Here the
parts take turns, so evaluation lengthens the run by its own time; over topics no phase waits for
it.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from codetr_ros.config import Settings, settled
from codetr_ros.cores.core import Core
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.simulator import Simulator
from codetr_ros.records import TOPICS, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.reports import NodeReport

_log = logging.getLogger(__name__)


def run(
    settings: Settings,
    run_id: str,
    folder: Path | None = None,
    observe: Callable[[Record], None] = lambda record: None,
    tick: Callable[[], None] = lambda: None,
    attend: Callable[[Mapping[str, tuple[str, Core[Record]]]], None] = lambda cores: None,
) -> dict[str, NodeReport]:
    """Run Algorithm 1 to its end.

    Args:
        settings: the run's settings; `threads` auto is decided here.
        run_id: its name.
        folder: where checkpoints and reports go; None: neither is written.
        observe: called with every record, in order. An error that it raises ends the run, after a
            checkpoint.
        tick: called after every slice of work; an error that it raises does the same.
        attend: called with the parts, each with its role by its name, before they begin.

    Returns:
        A report for each part of the run, as the nodes write them.

    Raises:
        RuntimeError: every part waits for another, which is a fault of this program.
    """
    settings = settled(settings)
    torch.set_num_threads(settings.thread_count)
    spec = settings.run_spec(run_id)
    checkpoints = folder / run_folder.CHECKPOINTS if folder else None
    cores: dict[str, tuple[str, Core[Record]]] = {
        name: ('sim', Simulator(spec, settings, name)) for name in settings.simulator_names
    }
    cores['record'] = ('record', Recorder(spec, settings, 'record'))
    if settings.labels_steps:
        cores['reward'] = ('reward', Labeller(spec, settings, 'reward', checkpoints))
    cores['learner'] = ('learner', Learner(spec, settings, 'learner', checkpoints))
    cores['evaluate'] = ('evaluate', Evaluator(spec, settings, 'evaluate'))
    published: dict[str, Counter[str]] = {name: Counter() for name in cores}
    received: dict[str, Counter[str]] = {name: Counter() for name in cores}
    seconds = dict.fromkeys(cores, 0.0)
    works = {name: core.work() for name, (_, core) in cores.items()}
    attend(cores)
    observe(spec)
    finished = False
    try:
        while not finished:
            idle = True
            for name, work in works.items():
                began = time.perf_counter()
                records = next(work)
                seconds[name] += time.perf_counter() - began
                tick()
                if records is None:
                    continue
                idle = False
                for record in records:
                    topic = TOPICS[type(record)]
                    published[name][topic] += 1
                    for reader, (_, core) in cores.items():
                        if type(record) in core.subscribes:
                            received[reader][topic] += 1
                            core.receive(record)
                    observe(record)
            finished = all(core.finished for _, core in cores.values())
            if idle and not finished:
                waiting = [name for name, (_, core) in cores.items() if not core.finished]
                raise RuntimeError(
                    'every part of the run waits for another: '
                    f'{", ".join(waiting)} have not finished'
                )
    finally:
        reports = {}
        for name, (role, core) in cores.items():
            core.close()
            reports[name] = node_reports.node_report(
                core.report(),
                role=role,
                name=name,
                published=published[name],
                received=received[name],
                refused={},
                cpu_s=seconds[name],
                wall_s=seconds[name],
                finished=core.finished,
                error=None,
            )
            if folder is not None:
                path = run_folder.report_path(folder, role, name)
                node_reports.write(path, reports[name])
    return reports
