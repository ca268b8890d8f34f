"""A page on a run with a robot: its scores by phase, its control steps, and what went wrong."""

from collections import Counter
from pathlib import Path

from codetr_ros.offline.score_course import ScoreCourse
from codetr_ros.runs import report
from codetr_ros.runs.document import Block, Facts, Heading, Links, Paragraph, Picture, page
from codetr_ros.runs.reports import NodeReport
from codetr_ros.system.parsing import parse_json

PAGE = 'robot.html'


def faults(log: Path) -> dict[str, int]:
    """What a stand-in robot noted that went wrong, by kind."""
    if not log.is_file():
        return {}
    lines = (parse_json(line) for line in log.read_text().splitlines())
    return dict(Counter(line['fault'] for line in lines if 'fault' in line))


def robot_page(
    title: str,
    course: ScoreCourse,
    outcome: dict[str, str],
    warmup: int,
    robot: NodeReport | None,
    noted: dict[str, int],
) -> str:
    """The page as HTML.

    Args:
        title: of the page.
        course: the scores.
        outcome: what to state of them, by name.
        warmup: phases of the random policy.
        robot: the report of the robot node, if it left one.
        noted: faults of the stand-in robot, by kind.
    """
    blocks: list[Block] = [
        Heading(title, 1),
        Facts(list(outcome.items())),
        Picture(report.given(course.rows(warmup)), 'mean score per step, by phase'),
        Heading('Control'),
    ]
    counters = robot.counters if robot else {}
    blocks.append(
        Facts([(name, str(n)) for name, n in sorted(counters.items())])
        if counters
        else Paragraph('the robot node left no report')
    )
    if noted:
        blocks.append(Heading('What went wrong with the stand-in robot, and no node has seen'))
        blocks.append(Facts([(name, str(n)) for name, n in sorted(noted.items())]))
    blocks.append(Links([('report.html', 'the report of the run'), ('scores.csv', 'the scores')]))
    return page(blocks)
