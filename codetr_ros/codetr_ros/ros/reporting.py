"""Writes the report of a node at its end."""

import resource
import time

from codetr_ros.ros.membership import Membership
from codetr_ros.ros.wiring import Wiring
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import CoreReport, NodeReport


class Reporting:
    """Writes the report of a node into the folder of its run, if it has one.

    Args:
        member: the node's membership.
    """

    def __init__(self, member: Membership) -> None:
        self._member = member
        self._started = time.monotonic()
        self._written: NodeReport | None = None

    def write(self, wiring: Wiring | None, finished: bool, error: str | None) -> None:
        """Write the report.

        Args:
            wiring: that of the node; None if it has not joined a run.
            finished: whether the node did everything that the run asked of it.
            error: why it gave up; None if it did not.
        """
        member = self._member
        if member.folder is None:
            return
        used = resource.getrusage(resource.RUSAGE_SELF)
        core_report = wiring.joined.core.report() if wiring else CoreReport()
        self._write(
            reports.node_report(
                core_report,
                role=member.role,
                name=member.link.name,
                published={t: n for t, n in member.link.published.items() if t != 'presence'},
                received=member.traffic.received,
                refused=member.traffic.refused,
                lost=member.traffic.lost(),
                fetched=member.traffic.recovered,
                cpu_s=used.ru_utime + used.ru_stime,
                wall_s=time.monotonic() - self._started,
                finished=finished,
                error=error,
                own=wiring.report() if wiring else None,
            )
        )

    def add_late_refusals(self) -> None:
        """Add what was refused since the report was written: a node that has finished may stay
        for long, because others may need it.
        """
        refused = self._member.traffic.counters()['refused']
        if self._written is not None and refused != self._written.refused:
            self._write(self._written.model_copy(update={'refused': refused}))

    def _write(self, report: NodeReport) -> None:
        member = self._member
        assert member.folder is not None
        path = run_folder.report_path(member.folder, member.role, member.link.name)
        reports.write(path, report)
        self._written = report
