"""What the nodes of a run counted and used, for its summary."""

import resource
from collections import Counter
from collections.abc import Mapping
from itertools import chain

from codetr_ros.records import TOPICS
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.run_summary import MessageCounts, ProcessUse


def count_messages(reports: Mapping[str, NodeReport]) -> dict[str, MessageCounts]:
    """The numbers of messages of each topic, and what became of them; a topic without messages has
    a row too.
    """
    columns: dict[str, Counter[str]] = {name: Counter() for name in MessageCounts.model_fields}
    for report in reports.values():
        columns['published'].update(report.published)
        if report.role in ('learner', 'reward'):
            columns[f'received_by_{report.role}'].update(report.received)
        if report.role == 'record':
            columns['recorded'].update(report.recorded)
            columns['different'].update(report.different)
        columns['lost'].update(report.lost)
        columns['duplicated'].update(report.duplicated)
        columns['refused'].update(report.refused)
    topics = dict.fromkeys([*TOPICS.values(), *chain.from_iterable(columns.values())])
    return {
        topic: MessageCounts.model_validate({n: column[topic] for n, column in columns.items()})
        for topic in topics
    }


def processes(reports: Mapping[str, NodeReport]) -> dict[str, ProcessUse]:
    """The resources that each process used, this one included."""
    used = {
        name: ProcessUse(
            role=report.role,
            peak_rss_mb=report.peak_rss_mb,
            cpu_s=report.cpu_s,
            wall_s=report.wall_s,
            finished=report.finished,
            error=report.error,
            exit_code=report.exit_code,
            restarts=report.restarts,
        )
        for name, report in sorted(reports.items())
    }
    own = resource.getrusage(resource.RUSAGE_SELF)
    used['codetr'] = ProcessUse(
        role='codetr',
        peak_rss_mb=own.ru_maxrss / 1024,
        cpu_s=own.ru_utime + own.ru_stime,
        wall_s=None,
        finished=None,
        error=None,
        exit_code=None,
        restarts=None,
    )
    return used
