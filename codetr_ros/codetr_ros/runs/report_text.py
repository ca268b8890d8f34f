"""What a run came to, in words and few numbers, for the page and the terminal."""

from collections.abc import Sequence

from codetr_ros.config import delay_in_words
from codetr_ros.runs import references
from codetr_ros.runs.numbers import exact, number, returns
from codetr_ros.runs.run_summary import GivenScores, RewardRecovery, RunSummary

NOT_EVALUATED = 'none: no policy was tried in simulation'


def inexact(summary: RunSummary) -> str:
    """What made the run's scores inexact, to follow their kind; empty if they were exact."""
    settings, parts = summary.settings, []
    if share := settings.get('score_missing'):
        parts.append(f'{share:.0%} missing')
    if noise := settings.get('score_noise'):
        parts.append(f'noise of {noise:g} deviations')
    if levels := settings.get('score_levels'):
        parts.append(f'on {levels} levels')
    return f' ({", ".join(parts)})' if parts else ''


def title(summary: RunSummary) -> str:
    """Names the run in a line."""
    s = summary
    given = f'{s.composite} of {delay_in_words(s.delay)}{inexact(s)}'
    what = f'{s.task}, {given}, {s.method}, seed {s.seed}'
    return what + (' (interrupted)' if s.interrupted else '')


def evaluations_missing(summary: RunSummary) -> str:
    """What the evaluations of a run lack, in a sentence; empty if they are complete."""
    missing, there = summary.evaluations_missing, len(summary.evaluated())
    if not missing:
        return ''
    return (
        f'{missing} of {missing + there} evaluations are missing or lack episodes: the evaluator '
        'was killed, or could not keep up. The weights are not affected; `codetr evaluate` '
        'measures them'
    )


def result_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """The few numbers that people look for first, for the page and the terminal."""

    def score(value: float | None) -> str:
        return 'not evaluated' if value is None else f'{value:.3f}'

    last = summary.evaluations[-1] if summary.evaluations else None
    std = last.true_return_std if last else None
    final, spread = returns(summary.final_true_return, std)
    (random,) = returns(summary.random_true_return)
    after = f' after {last.step} steps' if last else ''
    lacks = evaluations_missing(summary)
    evaluated = [
        ('score', f'{score(summary.final_score)}{after}'),
        ('score of the random policy', score(summary.random_score)),
        ('true return', (final or 'not evaluated') + (f' +- {spread}' if spread else '')),
        ('true return of the random policy', random or 'not evaluated'),
        *((f'... {name}', value) for name, value in _recorded(summary)),
        ('reward recovery', _recovery(summary)),
    ]
    return [
        *(evaluated if summary.evaluated() else [('evaluation', NOT_EVALUATED)]),
        *([('evaluations', lacks)] if lacks else []),
        *_given(summary.scores_given),
        ('steps', f'{summary.steps} of {summary.steps_planned}'),
        ('phases', f'{summary.phases} of {summary.phases_planned}'),
        ('time', f'{summary.wall_s:.1f} s, {summary.steps_per_s or 0:.0f} steps per second'),
        (
            'messages',
            f'{sum(row.published for row in summary.messages.values())} published, '
            f'{summary.lost} lost, {summary.duplicated} duplicated, {summary.refused} refused'
            + (f', {summary.different} came again as others' if summary.different else ''),
        ),
        *_left_out(summary),
    ]


def _given(rows: Sequence[GivenScores]) -> list[tuple[str, str]]:
    """The scores that others than the simulator gave, at the begin and at the end."""
    random = [row for row in rows if row.random]
    learnt = [row for row in rows if not row.random][-max(1, len(rows) // 5) :]
    shown = []
    for name, part in (('random policy', random), ('last fifth of the phases', learnt)):
        if count := sum(row.scores for row in part):
            mean = sum(row.scores * row.per_step for row in part) / count
            shown.append((f'score given per step, {name}', f'{mean:.3f}, mean of {count} scores'))
    return shown


def _left_out(summary: RunSummary) -> list[tuple[str, str]]:
    """Who was left out of phases, and of how many."""
    if not summary.left_out:
        return []
    words = ', '.join(f'{name}: {n} phases' for name, n in summary.left_out.items())
    return [('left out, as nothing came from them', words)]


def _recorded(summary: RunSummary) -> list[tuple[str, str]]:
    """What others ended with after as many steps, where that was recorded before."""
    beside = references.of(summary.settings)
    if beside is None or not summary.evaluations:
        return []
    ends = [(curve, curve.at(summary.evaluations[-1].step)) for curve in beside.curves]
    return [
        (f'with {curve.label}', f'{value:.1f}, mean of {curve.seeds} recorded runs')
        for curve, value in ends
        if value is not None
    ]


def _recovery(summary: RunSummary) -> str:
    """The agreement of step rewards with the true ones at the last comparison."""
    rows, evaluations = summary.reward_recovery, summary.evaluations
    if not rows:
        return 'no labels were compared'
    last = rows[-1]
    values = {'correlation': last.pearson, 'within segments': last.within}
    shown = [f'{name} {value:.2f}' for name, value in values.items() if value is not None]
    late = bool(evaluations) and evaluations[-1].step != last.step
    after = f', after {last.step} steps' if late else ''
    return (', '.join(shown) or 'not defined where one side does not vary') + after


def learnt(summary: RunSummary) -> str:
    """What the policy learnt, in a sentence; empty text if it was not evaluated."""
    last, random = summary.final_true_return, summary.random_true_return
    if last is None:
        return ''
    score = f', a score of {summary.final_score:.3f}' if summary.final_score is not None else ''
    values = returns(last, random)
    than = f' The random policy earns {values[1]}.' if random is not None else ''
    others = ', '.join(f'{name} {value}' for name, value in _recorded(summary))
    than += f' Other runs of this task: {others}.' if others else ''
    return (
        f'After {summary.evaluations[-1].step} steps the policy earns {values[0]} an episode'
        f'{score}.{than}'
    )


_GRADES = (
    (0.9, 'The inferred rewards single out the steps that matter almost as the true ones do.'),
    (0.6, 'The inferred rewards mostly single out the steps that matter.'),
    (0.3, 'The inferred rewards single out the steps that matter in part.'),
    (0.1, 'The inferred rewards hardly single out the steps that matter.'),
    (-1.0, 'The inferred rewards do not single out the steps that matter.'),
)
"""What a correlation within segments of at least so much means; the borders are our choice."""


def recovery_text(rows: Sequence[RewardRecovery]) -> str:
    """What the reward recovery of a run means, for people."""
    known = [row for row in rows if row.within is not None]
    if not known:
        return (
            'Inside segments nothing can be compared: the inferred or the true rewards do not '
            'vary there. An even spread of each score, for example, tells no step from another.'
        )
    first, last = known[0], known[-1]
    assert first.within is not None
    assert last.within is not None
    change = f'is {last.within:.2f} after {last.step} steps'
    if len(known) > 1:
        moved = last.within - first.within
        verb = 'rose' if moved > 0.05 else 'fell' if moved < -0.05 else 'stayed'
        place = 'about the same, ' if verb == 'stayed' else ''
        change = (
            f'{verb} {place}from {first.within:.2f} after {first.step} steps to {last.within:.2f} '
            f'after {last.step}'
        )
        if verb == 'fell':
            change += (
                '. It is measured on the steps in memory, which change as the policy does, so a '
                'fall need not mean that the model got worse'
            )
    grade = next(text for least, text in _GRADES if last.within >= least)
    return (
        f'{grade} Their correlation with the true rewards inside segments {change}. '
        '1 is perfect credit, 0 is none. The policy can be good where this is low: on some tasks '
        'any reward for staying alive is enough.'
    )


def scale_text(summary: RunSummary) -> str:
    """The scale of the inferred rewards beside that of the true ones; empty if not known."""
    last = summary.reward_recovery[-1] if summary.reward_recovery else None
    if last is None or last.inferred_mean is None or last.inferred_std is None:
        return ''
    values = (last.inferred_mean, last.inferred_std, last.true_mean, last.true_std)
    scale = max(abs(value) for value in values if value is not None) or 1.0
    inferred, about, true, around = (number(value, scale=scale) for value in values)
    text = (
        f'Over the {last.steps} labelled steps in memory, an inferred reward is {inferred} +- '
        f'{about} (mean and standard deviation), a true one {true} +- {around}.'
    )
    if summary.label_unit is None or summary.label_unit == 1:
        return text
    unit = exact(summary.label_unit, 4)
    return f'{text} The policy learns from the inferred ones in units of {unit}.'


_BARS = ' ▁▂▃▄▅▆▇█'


def sketch(values: Sequence[float], encoding: str | None) -> str:
    """A learning curve in a line of text: one bar for each value, the highest full."""
    bars = _BARS
    try:
        bars.encode(encoding or 'ascii')
    except (UnicodeEncodeError, LookupError):
        bars = ' .:-=+*#@'
    low, high = min(values), max(values)
    top = len(bars) - 1
    if high == low:
        return bars[1] * len(values)
    return ''.join(bars[1 + round((v - low) / (high - low) * (top - 1))] for v in values)
